"""Do bands hold what a bolted beam does, where the beam is integrated in time?

Run: python benchmarks/bolted_beams.py [--beams 40] [--seed 0] [--workers 2] [--out FOLDER]

Beams with thirty friction sliders spread over a joint, on three modes (`slip_integration.py`, which
shares nothing with the package): natural frequency and damping change with amplitude as slip has
it, slip couples the modes, and no family of curves is exact. Four or five levels of drive, each a
sweep of 25 steps up or down over the resonance, read as a test reads it: fundamental of velocity
and of the force between shaker and beam. In turn the beams have

- slip: nothing else;
- drift: natural frequencies that change by up to 0.05 % over the test, level after level;
- dropout: a shaker whose force falls at resonance, with a moving mass and an uneven field, so that
  force has harmonics and depends on level;
- all: drift and dropout;
- unsettled (`--unsettled`, in place of these): steps of 40 to 80 cycles, so that a state carries 5
  to 40 % of the difference from the one before.

Velocity and phase have 0.2 % noise, force 0.1 %; nothing is stated of it. Truth: the beam's own
phase resonance, found by a phase-locked loop in the same integration (with the drift at which the
level passed it), at every level's drive and between levels: frequency, velocity, and damping from
the power that the beam dissipates. Both the joint fit (smooth curves) and the
pointwise curve are judged there: shares inside 95 % bands, bias over their half-width, and answers
that neither holds, with and without a warning. One JSON line for every kind.
"""

import csv
import itertools
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import slip_integration as si
from harness import options, teller

tell = teller(__file__)

KINDS = ("slip", "drift", "dropout", "all")
SLIDERS, STATES = 30, 25
SCALE = 1e-4  # m, of the sliders' limits
SETTLED = 300  # cycles a step
TIMES = 1.96  # standard deviations of a 95 % band
WAYS = ("joint", "pointwise")
WARNINGS = {"residuals_correlated", "levels_differ", "modal_mass_moved", "fit_not_converged"}
"""Kinds of notes that say that bands may be wrong; noise that is not stated is no warning."""


class Test(NamedTuple):
    """One beam, its levels and how it is tested."""

    name: str
    kind: str
    beam: si.Beams  # a single row
    drives: np.ndarray  # N, of the levels
    drift: float  # relative change of the natural frequencies over the test
    upward: bool
    cycles: int  # a step
    seed: int


def drawn(kind: str, seed: int) -> Test:
    """A random beam and test of one kind."""
    random = np.random.default_rng(seed)
    orders = np.arange(1, si.N_MODES + 1)
    own = 2 * np.pi * random.uniform(60, 150) * orders**2.0
    damping = random.uniform(0.002, 0.004)
    places = random.uniform(0.35, 0.65) + random.uniform(-0.12, 0.12, SLIDERS)
    bending = np.sin(np.pi * places[:, None] * orders) * orders**2
    stiffness = random.lognormal(0, 0.4, SLIDERS)
    fraction = random.uniform(0.04, 0.1)  # of the first mode's stiffness, in the sliders
    stiffness *= fraction * own[0] ** 2 / (stiffness @ bending[:, 0] ** 2)
    limit = SCALE * random.uniform(0.02, 1, SLIDERS) ** random.uniform(1, 2)
    mass = random.uniform(2, 6)
    drive = np.sqrt(2 / mass) * np.sin(np.pi * random.uniform(0.25, 0.4) * orders)
    modal_mass = 1 / drive[0] ** 2
    moving = back = uneven = 0.0
    if kind in ("dropout", "all"):
        moving = random.uniform(0.005, 0.03) * modal_mass
        back = random.uniform(0.5, 2.0) * 2 * damping * own[0] * modal_mass
        uneven = random.uniform(0.01, 0.05) / (SCALE * drive[0]) ** 2
    drift = random.choice([-1, 1]) * random.uniform(2e-4, 5e-4) if kind in ("drift", "all") else 0.0
    row = si.Beams(
        *(part[None] for part in (own, np.array(damping), bending, stiffness, limit, drive)),
        *(np.array([one]) for one in (moving, back, uneven)),
    )
    amplitudes = SCALE * np.geomspace(0.06, random.uniform(0.6, 1.1), random.integers(4, 6))
    rate = 2 * (damping + fraction * 0.04 * amplitudes / SCALE) * own[0] + back / modal_mass
    drives = rate * own[0] * amplitudes / drive[0]
    cycles = int(random.integers(40, 81)) if kind == "unsettled" else SETTLED
    upward = bool(random.integers(2))
    return Test(f"{kind}_{seed}", kind, row, drives, drift, upward, cycles, seed)


class Rows(NamedTuple):
    """Levels of several tests, side by side."""

    beams: si.Beams
    drive: np.ndarray
    drift: np.ndarray  # when the level passed its resonance
    owner: np.ndarray  # which of the tests


def rows_of(tests: list[Test], *, between: bool) -> Rows:
    """The levels, and with `between` the drives halfway between two levels (on a log scale)."""
    drives, drifts, owner = [], [], []
    for k, test in enumerate(tests):
        places, n = np.arange(len(test.drives), dtype=float), len(test.drives)
        if between:
            places = np.sort(np.concatenate([places, places[1:] - 0.5]))
        drives.append(np.exp(np.interp(places, np.arange(n), np.log(test.drives))))
        drifts.append(test.drift * (places + 0.5) / n)
        owner.append(np.full(len(places), k))
    every = [np.concatenate([getattr(t.beam, f) for t in tests]) for f in si.Beams._fields]
    index = np.concatenate(owner)
    return Rows(si.Beams(*every).rows(index), np.concatenate(drives), np.concatenate(drifts), index)


def integrated(tests: list[Test], folder: Path) -> None:
    """Truth and measured tables of some tests with as many cycles a step, as files."""
    truth = rows_of(tests, between=True)
    frequency, ratio, shape = si.linear_modes(truth.beams)
    omega, at = si.phase_resonance(truth.beams, truth.drive, 0.99 * frequency[:, 0], truth.drift)
    speed = np.abs(at.velocity)
    damping = at.dissipated * shape[:, 0] ** 2 / (omega * speed**2)
    missed = np.abs(np.angle(at.velocity / at.force)) > 1e-3
    # Every level around its own resonance, a little off as a test is.
    rows = rows_of(tests, between=False)
    own = np.concatenate([np.flatnonzero(truth.owner == k)[::2] for k in range(len(tests))])
    random = np.random.default_rng([tests[0].seed, 1])
    shaker = rows.beams.back * shape[own, 0] ** 2 / (2 * omega[own])
    width = (damping[own] + shaker) * omega[own]  # half the bandwidth
    centre = omega[own] + width * random.uniform(-0.3, 0.3, len(own))
    sign = np.array([1 if test.upward else -1 for test in tests])[rows.owner]
    number = np.array([len(test.drives) for test in tests])[rows.owner]
    total = np.array([test.drift for test in tests])[rows.owner]
    state, places, tables = si.at_rest(rows.beams), np.linspace(-1, 1, STATES), []
    (cycles,) = {test.cycles for test in tests}
    for step, place in enumerate(places):
        now = centre + 2.5 * sign * place * width
        drift = rows.drift + total / number * ((step + 0.5) / STATES - 0.5)
        # The first state has time, as whoever begins a sweep gives it.
        dwell = SETTLED if step == 0 else cycles
        state, read = si.held(rows.beams, rows.drive, now, state, dwell, drift)
        tables.append((now, read.force, read.velocity))
    for k, test in enumerate(tests):
        mine = np.flatnonzero(rows.owner == k)
        noise = np.random.default_rng([test.seed, 2])
        lines = []
        for level, row in enumerate(mine, start=1):
            for now, force, velocity in tables:
                size, turn, of_force = noise.standard_normal(3)
                phasor = velocity[row] / force[row] * abs(force[row])
                phasor *= np.exp(0.002 * (size + 1j * turn))
                measured = abs(force[row]) * (1 + 0.001 * of_force)
                lines.append((level, now[row] / (2 * np.pi), measured, phasor.real, phasor.imag))
        head = ("level", "frequency_hz", "force_n", "velocity_re_m_s", "velocity_im_m_s")
        _write(folder / f"{test.name}.csv", head, lines)
        mine = np.flatnonzero(truth.owner == k)
        model = [f'name = "{test.name}"']
        for f, z, phi in zip(frequency[mine[0]], ratio[mine[0]], shape[mine[0]], strict=True):
            model += ["[[mode]]", f"frequency_hz = {f / (2 * np.pi)}", f"damping_ratio = {z}"]
            model += [f"shape = {{ drive_point = {phi} }}", f"participation = {phi}"]
        (folder / f"{test.name}.toml").write_text("\n".join(model) + "\n")
        found = (omega / (2 * np.pi), np.abs(at.force), speed, damping, missed)
        lines = list(zip(*(column[mine].tolist() for column in found), strict=True))
        head = ("frequency_hz", "force_n", "velocity_m_s", "damping_ratio", "missed")
        _write(folder / f"{test.name}.truth", head, lines)


def _write(path: Path, head: tuple[str, ...], lines: list[tuple]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([head, *lines])


def integrated_job(job: tuple[list[tuple[str, int]], Path]) -> None:
    """`integrated`, of tests drawn where the work is done."""
    tests = [drawn(*one) for one in job[0]]
    for _, some in itertools.groupby(sorted(tests, key=lambda t: t.cycles), lambda t: t.cycles):
        integrated(list(some), job[1])


def judged(job: tuple[Path, str]) -> dict[str, object]:
    """Errors over 1σ at every true resonance, by both ways, and what the fits warn of."""
    import snrmjax as sj  # the integration needs none of it

    folder, name = job
    model = sj.read_model(folder / f"{name}.toml")
    data = sj.read_steady_states(folder / f"{name}.csv", model)
    rows = np.genfromtxt(folder / f"{name}.truth", delimiter=",", names=True)
    rows = rows[[text != "True" for text in _last_column(folder / f"{name}.truth")]]
    fit, points = sj.fit_jointly(data, model), sj.identify_backbone(data, model)
    natural = 2 * np.pi * rows["frequency_hz"]
    errors, bands = scores(fit, points, rows["velocity_m_s"], natural, rows["damping_ratio"])
    return {
        **errors,
        "bands": bands,
        "notes": {
            way: [note.kind for note in found.notes]
            for way, found in zip(WAYS, (fit, points), strict=True)
        },
        "families": [fit.unknowns.squared_frequency.label, fit.unknowns.modal_damping.label],
        "converged": fit.converged,
        "missed": len(_last_column(folder / f"{name}.truth")) - len(rows),
    }


def scores(
    fit: object,
    points: object,
    speed: np.ndarray,
    natural: np.ndarray,
    ratio: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Errors over 1σ of frequency and damping by both ways at true phase resonances, and their 1σ.

    Arguments: `speed` in m/s, `natural` in rad/s and the damping `ratio` of the truths, relative to
    the model's modal mass. The 1σ are relative to the truth. Rows: frequency, damping.
    """
    import snrmjax as sj

    joint = sj.identify.fitted_values(fit, speed)
    # Damping of both is relative to the modal mass that a fit found: compared by its force.
    found = float(fit.problem.modal_mass_of(fit.unknowns) * abs(fit.problem.modal_constant))
    curve = points.backbone.values(speed / natural)
    errors, bands = {}, {}
    for way, values in (("joint", joint), ("pointwise", curve)):
        std = np.array([values.natural_frequency_std, found * values.damping_ratio_std])
        given = np.array([values.natural_frequency, found * values.damping_ratio])
        errors[way] = (given - [natural, ratio]) / std
        bands[way] = std / [natural, ratio]
    return errors, bands


def _last_column(path: Path) -> list[str]:
    return [line.rsplit(",", 1)[1].strip() for line in path.read_text().splitlines()[1:]]


def summary(mine: list[dict]) -> dict[str, object]:
    """Coverage, bias and silent errors of some beams."""
    line: dict[str, object] = {"beams": len(mine), "not_converged": 0}
    line["not_converged"] = sum(not row["converged"] for row in mine)
    line["truth_not_found"] = sum(row["missed"] for row in mine)
    each = {way: np.concatenate([row[way] for row in mine], axis=1) for way in WAYS}
    for way, place in itertools.product(WAYS, (0, 1)):
        z, name = each[way][place], ("frequency", "damping")[place]
        line[f"{way}_{name}_inside_95"] = float(np.mean(np.abs(z) < TIMES))
        line[f"{way}_{name}_bias_over_band"] = float(np.mean(z) / TIMES)
        bands = np.concatenate([row["bands"][way][place] for row in mine])
        line[f"{way}_{name}_relative_std"] = float(np.median(bands))
    outside, silent = 0, 0
    for row in mine:
        both = np.all([np.abs(row[way]) >= TIMES for way in WAYS], axis=0)
        outside += int(both.sum())
        silent += 0 if any(warned(row).values()) else int(both.sum())
    line["truths"] = int(each["joint"].shape[1])
    line["values_outside_both"], line["of_these_without_a_warning"] = outside, silent
    for way in WAYS:
        line[f"{way}_warns"] = float(np.mean([warned(row)[way] for row in mine]))
    return line


def warned(row: dict) -> dict[str, bool]:
    """Whether a way warned."""
    return {way: not WARNINGS.isdisjoint(row["notes"][way]) for way in WAYS}


def main() -> None:
    """Integrate the beams, identify them and print one line for every kind."""
    chosen = options(__doc__, beams=40, seed=0, workers=2, unsettled=False, out=Path)
    kinds = ("unsettled",) if chosen.unsettled else KINDS
    named = [(kinds[k % len(kinds)], chosen.seed + k) for k in range(chosen.beams)]
    with (
        tempfile.TemporaryDirectory() as spare,
        ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool,
    ):
        folder = chosen.out or Path(spare)
        folder.mkdir(parents=True, exist_ok=True)
        parts = [(named[k :: chosen.workers], folder) for k in range(chosen.workers)]
        list(pool.map(integrated_job, parts))
        rows = list(pool.map(judged, [(folder, f"{kind}_{seed}") for kind, seed in named]))
    for kind in (*kinds, "every kind"):
        mine = [r for (own, _), r in zip(named, rows, strict=True) if kind in (own, "every kind")]
        if mine:
            tell(kind=kind, **summary(mine))


if __name__ == "__main__":
    main()
