"""Pairs of options of `snrmjax import`: each is obeyed or refused, none is dropped without a word.

Run: python benchmarks/import_option_pairs.py [--runs 1200] [--seed 0]

Seven files (a table of amplitudes and phases, one of levels in dB, one of complex parts, frequency
responses, a matrix of them without frequencies, a record of steps, our own table) are imported with
a command that is right, to which one or two options are added: units, signs, columns, levels, wrong
words, options of other files. An import that ends with
exit 2 must say one sentence. One that ends with 0 must have written what a calculation of its own
(NumPy, a few lines, nothing of the package) makes of the same options; where that calculation knows
no meaning for an option, the import must not accept it.

One JSON line: runs, refused, right, and the bad ones with their options.
"""

import itertools
import tempfile
from pathlib import Path

import numpy as np
from harness import options, teller
from typer.testing import CliRunner

from snrmjax.numerics.rules import InputError

tell = teller(__file__)

HERTZ, POUND, GRAVITY = 2 * np.pi, 4.4482216152605, 9.80665
N = 12
F = 50 + 0.25 * np.arange(N)
COLUMNS = {
    "f": F,
    "f2": F + 7,
    "F": np.repeat([0.5, 0.8], N // 2),
    "G": np.repeat([0.7, 0.9], N // 2),
    "v": 0.1 + 0.01 * np.arange(N),
    "w": 0.3 + 0.02 * np.arange(N),
    "ph": 100 - 3.0 * np.arange(N),
    "ph2": 50 - 2.0 * np.arange(N),
    "fp": 5 + 1.0 * np.arange(N),
    "lev": np.repeat([4.0, 6.0], N // 2),
    "s": 1e-3 * (1 + np.arange(N)),
    "im": 0.02 * np.arange(N) - 0.1,
}
UNITS = {"N": 1.0, "lbf": POUND, "kN": 1e3, "V": 1.0, "dB re 1 N": 1.0}
MOTION = {"mm/s": (1, 1e-3), "g": (2, GRAVITY), "m/s": (1, 1.0), "mm": (0, 1e-3)}
CHOICES = {
    "frequency": ["f2", "nothing"],
    "frequency_unit": ["rad/s", "banana", "m"],
    "force": ["G", "nothing"],
    "frequency_start": [5, -1],
    "frequency_step": [0.5, -1],
    "rate": [999, 500, -3],
    "force_unit": ["lbf", "kN", "V", "g", "banana", "dB re 1 N", "dB"],
    "base": ["G:acceleration:g", "0.5:acceleration:g", "G:acceleration", "G", "G:velocity:m/s"],
    "unit": ["mm/s", "g", "banana", "dB re 1 m/s", "dB"],
    "force_phase": ["fp", "nothing"],
    "force_amplitude": ["0.4", "z", "name", "-1"],
    "over_force": [True],
    "phase_unit": ["rad", "grad"],
    "phase_sign": ["lag", "up"],
    "amplitude": ["rms", "peak_to_peak", "mean"],
    "level": ["lev", "runs", "file", "nothing"],
    "drive": ["G", "nothing"],
    "record": ["steps", "decay", "nothing"],
    "separator": ["tab", "comma", "pipe"],
    "decimal": ["comma", "hand"],
    "header_row": [1, 2, 99],
    "dataset": ["nothing"],
    "sensor": ["tip"],
    "phase": ["ph2", "nothing"],
    "imaginary": ["im", "nothing"],
    "amplitude_std": ["s", "nothing"],
    "phase_std": ["s", "nothing"],
}
SIZES = {"peak": 1.0, "rms": np.sqrt(2), "peak_to_peak": 0.5}


def expected(given, v=COLUMNS["v"], hz=None):
    """Frequency (Hz), load, velocity phasor of a table; None: nothing that can be meant."""
    hz = COLUMNS[given.get("frequency", "f")] if hz is None else hz
    hz = hz / (HERTZ if given.get("frequency_unit") == "rad/s" else 1)
    omega, size = HERTZ * hz, SIZES[given.get("amplitude", "peak")]
    over, factor_of_load = given.get("over_force"), UNITS.get(given.get("force_unit", "N"))
    base = given.get("base", "").split(":")
    lead = np.ones(N, dtype=complex)
    if base != [""]:
        column, motion, unit = (*base, "")[:3]
        order, factor = MOTION[unit] if unit else (None, None)
        if order is None or order != {"velocity": 1, "acceleration": 2}[motion]:
            return None
        named, factor_of_load = column in COLUMNS, factor
        load = (COLUMNS[column] if named else float(column)) * factor * size * np.ones(N)
        lead = (1j * omega) ** (2 - order)
    elif given.get("force"):
        if given.get("force_amplitude"):
            return None
        column = COLUMNS[given["force"]]
        column = 10 ** (column / 20) if given.get("force_unit", "").startswith("dB") else column
        load = column * UNITS[given.get("force_unit", "N")] * size
    else:
        if given.get("force_unit", "").startswith("dB"):
            return None
        load = float(given["force_amplitude"]) * UNITS[given.get("force_unit", "N")] * np.ones(N)
        load = load * (size if "amplitude" in given else 1.0)
    phase = np.zeros(N)
    unit = 1.0 if given.get("phase_unit") == "rad" else np.pi / 180
    sign = -1 if given.get("phase_sign") == "lag" else 1
    if given.get("force_phase"):
        phase = sign * unit * COLUMNS[given["force_phase"]]
    order, factor = MOTION[given.get("unit", "m/s")]
    if given.get("imaginary"):
        response = v + 1j * sign * COLUMNS[given["imaginary"]]
    else:
        response = v * np.exp(1j * sign * unit * COLUMNS[given.get("phase", "ph")])
    velocity = response * factor * (1j * omega) ** (1 - order)
    # Responses over the force are over its numbers, whatever their unit.
    velocity = velocity * (load / factor_of_load if over else size * np.exp(-1j * phase))
    return hz, load * np.abs(lead), velocity * np.exp(-1j * np.angle(lead))


def write_files(folder):
    """The files by kind, with the options of a right import."""
    import pyuff
    import scipy.io

    names = list(COLUMNS)
    rows = np.column_stack([COLUMNS[name] for name in names]).tolist()
    lines = [",".join(names), *(",".join(map(repr, row)) for row in rows)]
    (folder / "t.csv").write_text("\n".join(lines))
    (folder / "d.csv").write_text("\n".join(lines))
    columns = {name: COLUMNS[name] for name in names if name != "ph"}
    scipy.io.savemat(folder / "c.mat", {**columns, "v": COLUMNS["v"] + 1j * COLUMNS["im"]})
    place = {"rsp_node": 1, "rsp_dir": 3, "ref_node": 2, "ref_dir": 3}
    kind = {"func_type": 4, "abscissa_spacing": 0, "abscissa_spec_data_type": 18}
    kind |= {"ordinate_spec_data_type": 0, "orddenom_spec_data_type": 0}
    data = COLUMNS["v"] * np.exp(1j * np.radians(COLUMNS["ph"]))
    curve = pyuff.prepare_58(x=F, data=data, binary=1, z_axis_value=0.3, **place, **kind)
    pyuff.UFF(str(folder / "r.uff")).write_sets([curve], "add")
    marks = np.arange(N) % 2 == 0
    scipy.io.savemat(folder / "m.mat", {"H": np.stack([data, 2 * data]), "valid": marks})
    rate, seconds = 1000.0, 4.0
    time = np.arange(int(rate * seconds)) / rate
    steps = {"f": [], "a": []}
    for one in (50.0, 55.0, 60.0):
        steps["f"].append(0.5 * np.cos(HERTZ * one * time))
        steps["a"].append(0.2 * np.cos(HERTZ * one * time + 1.0))
    record = {"fs": rate, "F": np.concatenate(steps["f"]), "v": np.concatenate(steps["a"])}
    scipy.io.savemat(folder / "s.mat", record)
    own = ["level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s"]
    own += [
        f"1,{f!r},{g!r},{v.real!r},{v.imag!r}"
        for f, g, v in zip(F.tolist(), COLUMNS["F"].tolist(), data.tolist(), strict=True)
    ]
    (folder / "o.csv").write_text("\n".join(own))


BASE = {
    "t.csv": {"frequency": "f", "force": "F", "force_unit": "N", "response": "v:velocity:m/s"}
    | {"phase": "ph", "phase_unit": "deg"},
    "d.csv": {"frequency": "f", "force": "F", "force_unit": "N", "phase": "ph"}
    | {"phase_unit": "deg", "response": "v:velocity:dB re 1 m/s"},
    "m.mat": {"frequency_start": 50, "frequency_step": 0.25, "force_amplitude": "0.4"}
    | {"response": "H.1:velocity:m/s"},
    "c.mat": {"frequency": "f", "force": "F", "force_unit": "N", "response": "v:velocity:m/s"},
    "r.uff": {"force_amplitude": "0.4", "response": "1+z:velocity:m/s"},
    "s.mat": {"force": "F", "force_unit": "N", "response": "v:velocity:m/s", "record": "steps"},
    "o.csv": {},
}


def oracle(file, added):
    """What the import must give, or None: it must be refused."""
    told = dict(added)
    given = {key: word for key, word in BASE[file].items() if key != "response"} | told
    if "base" in told and not {"force", "force_unit", "force_amplitude"} & told.keys():
        for key in ("force", "force_unit", "force_amplitude"):
            given.pop(key, None)
    if "force" in told and "base" in told:
        return None
    # A unit that the response states already, and options that others leave without an effect.
    for key in ("sensor", "header_row", "separator", "level", "amplitude_std", "phase_std"):
        given.pop(key, None)
    if file == "t.csv":
        if "imaginary" in told and "phase" not in told:
            given.pop("phase", None)
        return expected(given)
    if file == "d.csv":
        if "imaginary" in told:
            return None
        return expected(given, 10 ** (COLUMNS["v"] / 20))
    if file == "m.mat":
        lines = given.pop("frequency_start") + given.pop("frequency_step") * np.arange(N)
        return expected(given | {"phase": "ph", "over_force": True}, hz=lines)
    if file == "c.mat":
        return expected(given | {"imaginary": "im"})
    if file == "r.uff":
        given = {"frequency": "f", "phase": "ph"} | given | {"over_force": True}
        if given.get("force_amplitude") == "z":
            given["force_amplitude"] = 0.3
        return expected(given)
    if file == "s.mat":
        hz = np.array([50.0, 55.0, 60.0]) * given.get("rate", 1000) / 1000
        if given.get("base"):
            return None  # there is no channel G
        size = UNITS[given.get("force_unit", "N")]
        return hz, np.full(3, 0.5 * size), np.full(3, 0.2 * np.exp(1j))
    size = SIZES[given.get("amplitude", "peak")]
    order, factor = MOTION[given.get("unit", "m/s")]
    phasor = COLUMNS["v"] * np.exp(1j * np.radians(COLUMNS["ph"])) * size * factor
    phasor = phasor * (1j * HERTZ * F) ** (1 - order)
    phasor = phasor.conj() if given.get("phase_sign") == "lag" else phasor
    load = COLUMNS["F"] * UNITS[given.get("force_unit", "N")] * size
    return F, load, phasor


def run(app, folder, file, added):
    """Exit code, what was said, and what was written."""
    import shutil

    words = [str(folder / file)]
    merged = BASE[file] | added
    for key, word in merged.items():
        if key in BASE[file] and key not in added and _replaced(key, added):
            continue
        words += [f"--{key.replace('_', '-')}", *([] if word is True else [str(word)])]
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    result = CliRunner().invoke(app, ["import", *words, "--out", str(out)])
    said = str(result.exception) if isinstance(result.exception, InputError) else result.output
    if result.exception is not None and not isinstance(result.exception, InputError | SystemExit):
        return 3, repr(result.exception), None
    code = 2 if isinstance(result.exception, InputError) else result.exit_code
    measured = out / "measured.csv"
    return code, said, measured.read_text() if measured.is_file() else None


def _replaced(key, added):
    """Whether an option of the right import is left out beside those that are added."""
    if "base" in added and key in ("force", "force_unit", "force_amplitude"):
        return True
    return "imaginary" in added and key in ("phase", "phase_unit") and "phase" not in added


def written(text):
    """Frequency, load and velocity of a table that was written."""
    lines = [line.split(",") for line in text.strip().splitlines()]
    head = lines[0]
    columns = {name: [row[k] for row in lines[1:]] for k, name in enumerate(head)}
    number = {
        name: np.array([float(word or "nan") for word in words])
        for name, words in columns.items()
        if name != "sensor"
    }
    load = number.get("force_n", number.get("drive_v"))
    if load is None:
        load = np.hypot(number["base_acceleration_re_m_s2"], number["base_acceleration_im_m_s2"])
    return number["frequency_hz"], load, number["velocity_re_m_s"] + 1j * number["velocity_im_m_s"]


def judge(file, added, code, said, text):
    """ "refused", "right", or what is bad."""
    if code == 2:
        one = "\n" not in said.strip() and len(said) < 1500
        return "refused" if one else f"no sentence: {said[:200]}"
    if code != 0:
        return f"exit {code}: {said[:200]}"
    if text is None:
        return "right" if "record" in added and added["record"] == "decay" else "nothing written"
    try:
        wanted = oracle(file, added)
    except (KeyError, ValueError) as error:
        return f"accepted what means nothing ({error})"
    if wanted is None:
        return "accepted what means nothing"
    found = written(text)
    tolerance = 1e-6 if file == "s.mat" else 1e-12
    for what, one, other in zip(("frequency", "load", "velocity"), found, wanted, strict=True):
        if one.shape != other.shape or not np.allclose(one, other, rtol=tolerance, atol=0):
            return f"silent: another {what}"
    return "right"


def main():
    """Run all single options and some pairs."""
    asked = options(__doc__, runs=1200, seed=0)
    from snrmjax.cli import app

    rng = np.random.default_rng(asked.seed)
    single = [(key, word) for key, words in CHOICES.items() for word in words]
    jobs = [(file, dict([one])) for file in BASE for one in single]
    pairs = [
        (file, {a[0]: a[1], b[0]: b[1]})
        for file in BASE
        for a, b in itertools.combinations(single, 2)
        if a[0] != b[0]
    ]
    jobs += [pairs[k] for k in rng.permutation(len(pairs))[: asked.runs]]
    counts, bad = {"refused": 0, "right": 0}, []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_files(folder)
        for file, added in jobs:
            outcome = judge(file, added, *run(app, folder, file, added))
            if outcome in counts:
                counts[outcome] += 1
            else:
                bad.append({"file": file, "options": {k: str(v) for k, v in added.items()}})
                bad[-1]["why"] = outcome
    tell(runs=len(jobs), seed=asked.seed, **counts, bad=len(bad), first=bad[:20])


if __name__ == "__main__":
    main()
