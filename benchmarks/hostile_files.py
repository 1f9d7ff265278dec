"""Hostile laboratory files: mutated ones of every format must give data or a clear error.

Run: python benchmarks/hostile_files.py [--runs 20000] [--seed 0] [--only KIND]

Valid files of every format (UFF 58, 58b and 55, MATLAB v4, v5 and v7.3, HDF5, netCDF, TDMS, CSV in
two dialects, a LabVIEW measurement file, runs side by side, a vibrometer's export, thousands, times
of few digits, levels in dB, objects of MATLAB, Octave's text, a start and a step, units by row,
odd time steps, one force for all rows) are mutated:
cut, bits flipped, counts made huge, runs overwritten, NaN put in, parts doubled, text for binary,
two formats spliced, gzip and zip around them, one in another. Each is
listed, and what it holds is read and imported, in a child process whose address space may grow by
1 GiB, with ten seconds a file; the peak of resident memory above that after the imports is
measured file by file (Linux). Good is: data, or a `InputError` of one sentence; of a text every
number that was read must stand in it. Everything else is bad and is kept beside the temporary
folder for a look.

One JSON line: files, outcomes by kind, worst memory in MB, worst time in s, and the bad ones.
"""

import collections
import contextlib
import gzip
import io
import multiprocessing
import os
import re
import resource
import signal
import struct
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
from harness import options, teller

from snrmjax.numerics.rules import InputError

tell = teller(__file__)

SECONDS, MEGABYTES, GUARD = 10, 200, 2**30


def valid_files(folder):
    """Valid files of every format by name."""
    import h5py
    import pyuff
    import scipy.io
    from nptdms import ChannelObject, TdmsWriter

    from snrmjax.io.exchange.exports import write_netcdf
    from snrmjax.measure import Channel, time_recording

    rng = np.random.default_rng(1)
    hertz = np.linspace(79, 81, 40)
    record = time_recording(
        rng.normal(size=(2, 300)),
        [
            Channel("CH1", "force", "N", 1.0, "1", "+z"),
            Channel("CH2", "acceleration", "g", 9.8, "2", "+z"),
        ],
        1000.0,
    )
    place = {"rsp_node": 1, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3}
    frf = {
        "func_type": 4,
        "abscissa_spacing": 0,
        "abscissa_spec_data_type": 18,
        "z_axis_value": 0.1,
    }
    frf |= {"ordinate_spec_data_type": 11, "orddenom_spec_data_type": 13}
    wave = {"func_type": 1, "abscissa_spacing": 1, "abscissa_spec_data_type": 17}
    wave |= {"ordinate_spec_data_type": 13, "orddenom_spec_data_type": 0}
    time, values = np.arange(300) / 1000, rng.normal(size=300)
    for name, binary in (("a.uff", 1), ("b.uff", 0)):
        curve = pyuff.prepare_58(x=hertz, data=values[:40] + 1j, binary=binary, **place, **frf)
        tone = pyuff.prepare_58(x=time, data=values, binary=binary, **place, **wave)
        pyuff.UFF(str(folder / name)).write_sets([curve, tone], "add")
    cells = {"fs": 1000.0, "signal": record.values().T, "names": np.array(["a", "b"], dtype=object)}
    steps = {"freq": hertz, "force": hertz / 800, "v": values[:40] ** 2}
    scipy.io.savemat(folder / "a.mat", {"run": cells, "steps": steps})
    kinds = [(key, object) for key in ("freq", "force", "amplitude", "phase")]
    rows = [(hertz, hertz * 0 + 0.1 * k, hertz / 80, hertz) for k in (1, 2)]
    scipy.io.savemat(folder / "b.mat", {"d": np.array(rows, dtype=kinds)}, do_compression=True)
    old = {"freq": hertz, "H": hertz + 1j, "title": "of level 4"}
    scipy.io.savemat(folder / "d.mat", old, format="4")
    write_netcdf(folder / "a.nc", record)
    with h5py.File(folder / "a.h5", "w") as file:
        for key, values in zip(("freq", "F", "X", "Y"), rng.normal(size=(4, 200)), strict=True):
            file.create_dataset(f"test/{key}", data=values, compression="gzip", chunks=(50,))
        file["test"].create_dataset("signal", data=rng.normal(size=(4, 1000)))
        file["test"].attrs["fs"] = 100.0
        file["test/signal"].attrs["unit"] = "N"  # a text of varying length
        names = np.array(["a", "b", "c", "d"], dtype=object)
        kind = h5py.string_dtype()
        file["test"].create_dataset("names", data=names, dtype=kind, chunks=(2,), compression=4)
    with h5py.File(folder / "c.mat", "w", userblock_size=512) as file:
        for key in ("freq", "force", "v"):
            one = file.create_dataset(key, data=rng.normal(size=(1, 30)))
            one.attrs["MATLAB_class"] = np.bytes_(b"double")
    with open(folder / "c.mat", "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM")
    with TdmsWriter(folder / "a.tdms") as writer:
        for _ in range(3):
            wave = {"wf_increment": 1e-3, "unit_string": "N"}
            writer.write_segment(
                [ChannelObject("g", f"CH{k}", rng.normal(size=90), wave) for k in range(2)]
            )
        writer.write_segment([ChannelObject("t", "frequency", hertz, {})])
    lines = [f"{f!r},{0.1!r},{f / 80!r},{f!r}" for f in hertz.tolist()]
    (folder / "a.csv").write_text("\n".join(["f (Hz),F (N),v (mm/s),phase (deg)", *lines]))
    dialect = [line.replace(",", ";").replace(".", ",") for line in lines]
    (folder / "b.txt").write_text("\n".join(["Titel", "f;F;v;phase", "Hz;N;g;°", *dialect]))
    write_texts(folder, rng, hertz)
    write_other_customs(folder, rng, hertz)
    return {one.name: one.read_bytes() for one in sorted(folder.iterdir())}


def write_texts(folder, rng, hertz):
    """Texts that describe themselves, and channels that start apart."""
    from nptdms import ChannelObject, TdmsWriter

    def comma(*fields, by="\t"):
        return by.join(str(field).replace(".", ",") for field in fields)

    numbers = rng.normal(size=(90, 2)).round(6)
    head = ["LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,"]
    head += ["X_Columns\tNo", "Time_Pref\tRelative", "***End_of_Header***\t"]
    part = ["", "Channels\t2", "Samples\t90\t90", "Date\t2026/01/05\t2026/01/05"]
    part += ["Y_Unit_Label\tNewtons\tm/s^2", "X_Dimension\tTime\tTime", "X0\t0,0\t0,0"]
    part += ["Delta_X\t1,0E-3\t1,0E-3", "***End_of_Header***\t\t", "X_Value\tF\ta\tComment"]
    part += [comma("", *row) for row in numbers.tolist()]
    (folder / "c.lvm").write_text("\n".join([*head, *part, *part]))
    names = comma("X-Data [Hz]", *["Vib [m/s]", "Phase [Deg]"] * 2)
    labels = comma("", "002: [01-05-26 09:28]", "", "003: [01-05-26 09:35]", "")
    four = rng.normal(size=(40, 4)).round(6)
    rows = [comma(f, *row) for f, row in zip(hertz.round(4).tolist(), four.tolist(), strict=True)]
    (folder / "d.txt").write_text("\r\n".join([names + "\t", labels + "\t", *rows]))
    rows = [f"{k / 1000:.3f}\t{value!r}" for k, value in enumerate(numbers[:, 0].tolist())]
    head = ["Point Index:\t1", "Signal:\tTime - Vib Velocity - Samples", "", "Time\tTime Signal"]
    (folder / "e.txt").write_text("\n".join([*head, "[ s ]\t[ m/s ]", *rows]))
    start = np.datetime64("2026-01-05T10:00:00.000000")
    with TdmsWriter(folder / "f.tdms") as writer:
        for k in range(2):
            wave = {"wf_increment": 1e-3, "unit_string": "N"}
            wave |= {"wf_start_time": start + np.timedelta64(5000 * k, "us")}
            writer.write_segment([ChannelObject("g", f"CH{k}", rng.normal(size=300), wave)])


def write_other_customs(folder, rng, hertz):
    """Thousands, few digits, levels in dB, objects of MATLAB, Octave's text, a start and a step."""
    import scipy.io

    def german(number):
        return f"{number:,}".replace(",", "T").replace(".", ",").replace("T", ".")

    rows = [(int(990 + k), 0.5, int(1000 + 9 * k), k - 20.5) for k in range(40)]
    lines = [";".join(map(german, row)) for row in rows]
    (folder / "g.csv").write_text("\n".join(["f [Hz];F [N];v [mm/s];phase [deg]", *lines]))
    rows = [f"{k / 5120:.4g},{v!r}" for k, v in enumerate(rng.normal(size=300).tolist())]
    (folder / "h.csv").write_text("\n".join(["Time [s],v [m/s]", *rows]))
    rows = [f"{f!r},0.1,{-20 - f / 9!r},{f!r}" for f in hertz.tolist()]
    (folder / "i.csv").write_text("\n".join(["f [Hz],F [N],v [dB re 1 m/s],phase [deg]", *rows]))
    response = rng.normal(size=(40, 3)) + 1j
    single = {"f_start": 10.0, "df": 0.5, "flags": np.arange(40) % 2 == 0}
    scipy.io.savemat(folder / "j.mat", {"H": response, **single})
    scipy.io.savemat(folder / "k.mat", {"freq": hertz, "force": hertz / 800, "v": hertz**2})
    with open(folder / "k.mat", "ab") as file:
        file.write(object_of_matlab())
    text = ["# Created by Octave 6.4.0", "# name: test", "# type: scalar struct", "# ndims: 2"]
    text += [" 1 1", "# length: 3"]
    for name, values in (("freq", hertz), ("force", hertz / 800)):
        text += [f"# name: {name}", "# type: matrix", "# rows: 40", "# columns: 1"]
        text += [*(f" {value!r}" for value in values.tolist()), "", ""]
    text += ["# name: v", "# type: complex matrix", "# rows: 40", "# columns: 1"]
    text += [*(f" ({value!r},1)" for value in hertz.tolist()), "", "", "", ""]
    text += ["# name: c", "# type: cell", "# rows: 1", "# columns: 1", "# name: <cell-element>"]
    text += ["# type: string", "# elements: 1", "# length: 3", "tip", "", "", ""]
    (folder / "l.mat").write_text("\n".join(text))
    write_times_and_units_by_row(folder, rng, hertz)


def write_times_and_units_by_row(folder, rng, hertz):
    """A unit after each number, one in a column, one odd time step, one force for all rows."""
    import scipy.io

    rows = [f"{f!r} Hz,0.1 N,{f / 80!r} mm/s,{f!r} deg" for f in hertz.tolist()]
    (folder / "m.csv").write_text("\n".join(["f,F,v,phase", *rows]))
    rows = [f"{f!r},0.1,{f / 80!r},mm/s,{f!r}" for f in hertz.tolist()]
    (folder / "n.csv").write_text("\n".join(["f [Hz],F [N],v,unit,phase [deg]", *rows]))
    times = np.arange(300) / 1000 + 0.0004 * (np.arange(300) > 150)
    rows = [f"{t:.4f},{v!r}" for t, v in zip(times, rng.normal(size=300).tolist(), strict=True)]
    (folder / "o.csv").write_text("\n".join(["Time [s],v [m/s]", *rows]))
    scipy.io.savemat(folder / "p.mat", {"freq": hertz, "F": 0.1, "v": hertz + 1j})
    levels = {"freq": hertz[:, None], "F": [[0.1, 0.2]], "v": np.stack([hertz, hertz**2], axis=1)}
    scipy.io.savemat(folder / "q.mat", levels)


def object_of_matlab():
    """A variable that is a table, as MATLAB writes one."""

    def element(number, data):
        return struct.pack("<II", number, len(data)) + data + bytes(-len(data) % 8)

    flags = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1))
    inner = flags + element(1, b"") + element(6, struct.pack("<6I", 3707764736, 2, 1, 1, 1, 1))
    texts = element(1, b"log") + element(1, b"MCOS") + element(1, b"table")
    return element(14, element(6, struct.pack("<II", 17, 0)) + texts + element(14, inner))


def invented(path, held):
    """A number that a text does not have, or nothing: each that was read must stand there."""
    if path.suffix not in (".lvm", ".txt", ".csv"):
        return ""
    is_resampled = any(note.kind == "time_resampled" for note in held.notes)
    if is_resampled or path.name.endswith(("m.csv", "n.csv")):  # with units by row
        return ""
    text = path.read_bytes().decode("cp1252", errors="replace")
    fields = re.split(r"[\t;\s\"]+", text) + re.split(r"[\t;,\s\"]+", text)
    there = {0.0}
    for field in fields:
        whole = field.replace(".", "").replace(",", ".")  # with separators of thousands
        for word in (field, field.replace(",", "."), whole, field.replace(",", "")):
            with contextlib.suppress(ValueError):
                there.add(float(word.lower().replace("d", "e")))
    columns = {
        name: values
        for table in held.tables
        for name, values in table.columns.items()
        if name not in ("run", "time", "frequency")
    }
    columns |= {
        channel.name: record.samples.read([k], 0, record.n_samples)[0]
        for record in held.recordings
        for k, channel in enumerate(record.channels)
    }
    for name, values in columns.items():
        steps = np.diff(np.asarray(values))
        if len(steps) and np.allclose(steps, steps[0], rtol=1e-6):
            continue  # an abscissa that a step states
        for value in np.asarray(values).tolist():
            if value == value and value not in there:
                return f"{name} has {value!r}, which the file does not"
    return ""


def mutated(files, name, rng):
    """A hostile version of a file, and what was done to it."""
    data = bytearray(files[name])
    kinds = [
        "cut",
        "flip",
        "count",
        "count",
        "run",
        "nan",
        "double",
        "text",
        "splice",
        "pack",
        "digits",
        "flip",
    ]
    kind = kinds[rng.integers(len(kinds))]
    size = len(data)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(max(1, len(data))))
        near = int(rng.integers(min(len(data), 600)))  # headers are at the start
        at = at if rng.random() < 0.5 else near
        if kind == "cut":
            data = data[: max(1, at)]
        elif kind == "flip":
            for _ in range(int(2 ** rng.uniform(0, 5))):
                k = at if rng.random() < 0.3 else int(rng.integers(len(data)))
                data[min(k, len(data) - 1)] ^= 1 << int(rng.integers(8))
        elif kind == "count":
            value = int(rng.choice([2**31 - 1, 2**32 - 1, 2**62, 2**63 - 1, 2**24, 2**40, 0]))
            width = 8 if value >= 2**32 or rng.random() < 0.5 else 4
            at -= at % 4
            order = "little" if rng.random() < 0.8 else "big"
            data[at : at + width] = value.to_bytes(width, order)
        elif kind == "run":
            length = int(rng.integers(1, 200))
            data[at : at + length] = bytes([int(rng.choice([0, 255, 32, 57]))]) * length
        elif kind == "nan":
            word = rng.choice([b"nan", b"inf", b"-1e999", np.float64(np.nan).tobytes()])
            data[at : at + len(bytes(word))] = bytes(word)
        elif kind == "double":
            length = int(rng.integers(1, size))
            data[at:at] = data[at : at + length]
        elif kind == "text":
            words = "Lorem ipsum, 12; 3,4\t-1e5 \n€".encode() * int(rng.integers(1, 30))
            data[at : at + len(words)] = words
        elif kind == "splice":
            other = files[sorted(files)[rng.integers(len(files))]]
            data = data[:at] + bytearray(other[int(rng.integers(len(other))) :])
        elif kind == "digits":
            places = [k for k, one in enumerate(data[:4000]) if 48 <= one <= 57]
            for k in rng.choice(places, size=min(len(places), 12)) if places else []:
                data[int(k)] = 57
    if kind == "pack":
        inner = gzip.compress(bytes(data) * int(rng.integers(1, 50)))
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.csv", inner)
        data = bytearray(inner if rng.random() < 0.5 else buffer.getvalue())
        if rng.random() < 0.5:
            data = bytearray(gzip.compress(bytes(data)))
    return bytes(data), kind


def digest(path):
    """List a file, read what it holds, and import it; returns the outcome."""
    from snrmjax.io.exchange.import_map import ImportMap, response_word
    from snrmjax.io.exchange.importing import import_files
    from snrmjax.io.exchange.listing import listed_contents
    from snrmjax.io.exchange.proposals import proposed_commands
    from snrmjax.io.laboratory.reading import read_laboratory_file

    try:
        held = read_laboratory_file(path)
    except InputError as error:
        return checked(error, "refused")
    outcome = "data"
    listed_contents(held)
    proposed_commands([path], [held])
    if other := invented(path, held):
        return f"BAD number: {other}"
    for record in held.recordings:
        try:
            record.values(stop=min(record.n_samples, 2**16))
            record.values(start=max(0, record.n_samples - 100))
        except InputError as error:
            outcome = checked(error, "refused late")
    first = held.recordings[0].channel_names if held.recordings else ()
    table = list(held.tables[0].columns) if held.tables else []
    pairs = [(first[0], first[-1])] if first else []
    pairs += [(table[1], table[2])] if len(table) > 3 else []
    pairs += [("", held.responses[0].responses[0].name)] if held.responses else []
    for force, response in pairs:
        told = ImportMap(
            (response_word(f"{response}:velocity:m/s"),),
            force=force,
            force_unit="N" if force else "",
            force_amplitude=("1.0",),
            phase_unit="deg",
            record="decay",
            dataset="responses" if not force and len(pairs) > 1 else "",
        )
        try:
            import_files([path], told)
        except InputError as error:
            checked(error, "")
    return outcome


def checked(error, outcome):
    """The outcome of an error, which must be one sentence of the package's own."""
    text = str(error)
    if "\n" in text.strip() or len(text) > 2000 or not isinstance(error, InputError):
        return f"BAD message: {type(error).__name__}: {text[:200]}"
    return outcome


def resident(key):
    """VmRSS or VmHWM in MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"the system does not state {key}")


def work(connection, folder, files):
    """Read files by number until told to stop."""
    import warnings

    warnings.simplefilter("ignore")
    for name in files:  # imports and caches are there before memory is measured
        path = Path(folder) / f"warm-{name}"
        path.write_bytes(files[name])
        if digest(path) != "data":
            raise RuntimeError(f"{name} must be read as it is")
        path.unlink()
    before = resident("VmRSS")
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + GUARD, space + GUARD))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the process: the parent sees it
    connection.send(("ready", before))
    while True:
        job = connection.recv()
        if job is None:
            return
        path, _ = job
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        signal.alarm(SECONDS)
        start = time.perf_counter()
        try:
            outcome = digest(Path(path))
        except BaseException as error:
            outcome = f"BAD {type(error).__name__}: {str(error)[:200]}"
        spent = time.perf_counter() - start
        signal.alarm(0)
        connection.send((outcome, spent, resident("VmHWM") - before))


def start_worker(folder, files):
    """A fresh child process that is ready."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=work, args=(there, folder, files), daemon=True)
    process.start()
    there.close()
    here.recv()
    return process, here


def main():
    """All runs and one line of figures."""
    chosen = options(__doc__, runs=20_000, seed=0, only="")
    counts, bad = collections.Counter(), []
    by_format = collections.Counter()
    worst_time = worst_memory = 0.0
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "valid").mkdir()
        files = valid_files(folder / "valid")
        names = [name for name in sorted(files) if chosen.only in name]
        process, pipe = start_worker(text, files)
        began = time.perf_counter()
        for k in range(chosen.runs):
            rng = np.random.default_rng([chosen.seed, k])
            name = names[k % len(names)]
            data, kind = mutated(files, name, rng)
            path = folder / f"hostile-{name}"
            path.write_bytes(data)
            pipe.send((str(path), k))
            try:
                outcome, spent, memory = pipe.recv()
            except EOFError:
                process.join()
                outcome, spent, memory = f"BAD died with {process.exitcode}", float(SECONDS), 0.0
                process, pipe = start_worker(text, files)
            if memory > MEGABYTES:
                outcome = f"BAD {memory:.0f} MB after {outcome}"
            by_format[f"{name}: {outcome.split(':')[0].split(' ')[0]}"] += 1
            counts[outcome if not outcome.startswith("BAD") else "BAD"] += 1
            worst_time, worst_memory = max(worst_time, spent), max(worst_memory, memory)
            if outcome.startswith("BAD"):
                bad.append((k, name, kind, outcome))
                print(bad[-1], flush=True)
        pipe.send(None)
        figures = {
            "files": chosen.runs,
            "formats": len(names),
            "outcomes": dict(counts),
            "by_format": dict(sorted(by_format.items())),
            "worst_memory_mb": round(worst_memory, 1),
            "worst_time_s": round(worst_time, 2),
            "seconds": round(time.perf_counter() - began),
            "bad": len(bad),
            "cores": os.cpu_count(),
        }
    tell(**figures)


if __name__ == "__main__":
    main()
