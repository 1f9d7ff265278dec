"""Joint fits of the two measured beams, judged by levels that were left out of them.

Run: python benchmarks/joint_fit_measured.py --data FOLDER

FOLDER holds `brake_reuss_beam` and `suspended_beam` with a CSV and a `model.toml` each.

Brake-Reuss beam: fitted to six of its eight levels, each pair of levels predicted in turn; the
velocity and frequency at phase resonance under the force of a left-out level are compared with
that level's own states, interpolated to resonance. Suspended beam: force gain and phase free;
frequency and damping from zero to the largest velocity; two halves of the levels fitted
separately, compared in units of their bands. Both: whitened residuals and the notes of the fit.
One JSON line each.
"""

import itertools
import time
from pathlib import Path

import numpy as np
from harness import options, teller

import snrmjax as sj

tell = teller(__file__)

HERTZ = 2 * np.pi


def load(folder: Path, table: str) -> tuple[sj.measure.SteadyStates, sj.model.Structure]:
    """Data and model of one beam."""
    model = sj.read_model(folder / "model.toml")
    return sj.read_steady_states(folder / table, model), model


def at_resonance(data: sj.measure.SteadyStates, level: int) -> tuple[float, float, float]:
    """Frequency, velocity and force of a level where the phase passes zero, by interpolation."""
    mine = np.asarray(data.level) == level
    velocity = np.asarray(data.velocity)[mine, 0]
    phase, order = np.angle(velocity), np.argsort(-np.angle(velocity))
    columns = (np.asarray(data.frequency)[mine], np.abs(velocity), np.asarray(data.force)[mine])
    return tuple(float(np.interp(0.0, -phase[order], c[order])) for c in columns)


def held_out(data: sj.measure.SteadyStates, model: sj.model.Structure) -> None:
    """Every pair of levels predicted by the other six."""
    levels = np.unique(np.asarray(data.level)).tolist()
    rows, times = [], []
    for pair in itertools.combinations(levels, 2):
        keep = ~np.isin(np.asarray(data.level), pair)
        begin = time.perf_counter()
        fit = sj.fit_jointly(data.select(keep), model.modes)
        times.append(time.perf_counter() - begin)
        inside = set(levels[1:-1])
        for level in pair:
            frequency, velocity, force = at_resonance(data, level)
            found = [p for c in sj.identify.fitted_response(fit, force) for p in c.resonances]
            if not found:
                rows.append((level, level in inside, np.nan, np.nan, np.nan, np.nan))
                continue
            best = min(found, key=lambda p: abs(p.velocity - velocity))
            rows.append(
                (
                    *(level, level in inside, best.velocity / velocity - 1),
                    (best.frequency - frequency) / HERTZ,
                    best.velocity_std / velocity,
                    best.frequency_std / HERTZ,
                )
            )
    table = np.array(rows, dtype=float)
    for name, chosen in (("inside", table[:, 1] == 1), ("ends", table[:, 1] == 0)):
        part = table[chosen]
        tell(
            measurement="left-out levels",
            beam="brake_reuss",
            levels=name,
            predicted=len(part),
            velocity_error_median=np.nanmedian(np.abs(part[:, 2])),
            velocity_error_largest=np.nanmax(np.abs(part[:, 2])),
            within_5_per_cent=np.mean(np.abs(part[:, 2]) < 0.05),
            frequency_error_median_hz=np.nanmedian(np.abs(part[:, 3])),
            frequency_error_largest_hz=np.nanmax(np.abs(part[:, 3])),
            within_0_15_hz=np.mean(np.abs(part[:, 3]) < 0.15),
            # A left-out level has a gain error of its own, of the estimated 1σ.
            velocity_inside_95=np.mean(np.abs(part[:, 2]) < 1.96 * part[:, 4]),
            velocity_std_median=np.nanmedian(part[:, 4]),
            not_found=int(np.isnan(part[:, 2]).sum()),
        )


def describe(name: str, fit: sj.identify.JointFit, seconds: float) -> None:
    """Curves, noise and notes of a fit of all levels."""
    at = np.linspace(0.0, fit.largest[1], 6)
    values = sj.identify.fitted_values(fit, at)
    tell(
        measurement="fit",
        beam=name,
        seconds=seconds,
        families=[fit.unknowns.squared_frequency.label, fit.unknowns.modal_damping.label],
        velocity=at,
        natural_frequency_hz=np.asarray(values.natural_frequency) / HERTZ,
        natural_frequency_std_hz=np.asarray(values.natural_frequency_std) / HERTZ,
        damping_per_cent=100 * np.asarray(values.damping_ratio),
        damping_std_per_cent=100 * np.asarray(values.damping_ratio_std),
        noise_scale=fit.noise.scale,
        level_std=fit.noise.level_std,
        whitened_rms=np.sqrt(np.mean(fit.residuals**2)),
        notes=list(map(str, fit.notes)),
    )


def halves(data: sj.measure.SteadyStates, model: sj.model.Structure, free: tuple[str, ...]) -> None:
    """Odd and even levels fitted apart, where both have amplitudes."""
    fits, ends = [], []
    for odd in (True, False):
        part = data.select((np.asarray(data.level) % 2 == 1) == odd)
        fit = sj.fit_jointly(part, model.modes, free=free)
        fits.append(fit)
        ends.append((np.abs(np.asarray(fit.motion().velocity)).min(), fit.largest[1]))
    at = np.linspace(max(e[0] for e in ends), min(e[1] for e in ends), 12)
    one, two = (sj.identify.fitted_values(fit, at) for fit in fits)
    gaps = {
        "frequency": (one.natural_frequency - two.natural_frequency)
        / np.hypot(one.natural_frequency_std, two.natural_frequency_std),
        "damping": (one.modal_damping - two.modal_damping)
        / np.hypot(one.modal_damping_std, two.modal_damping_std),
    }
    tell(
        measurement="two halves of the levels",
        beam="suspended",
        velocity=at,
        **{f"{k}_gap_in_std": v for k, v in gaps.items()},
        **{f"{k}_within_2_std": np.mean(np.abs(np.asarray(v)) < 2) for k, v in gaps.items()},
        frequency_gap_hz=np.max(np.abs(one.natural_frequency - two.natural_frequency)) / HERTZ,
        damping_gap_relative=np.max(np.abs(one.modal_damping / two.modal_damping - 1)),
        notes=[list(map(str, fit.notes)) for fit in fits],
    )


def main() -> None:
    """Both beams."""
    chosen = options(__doc__, data=Path)
    brake, brake_model = load(chosen.data / "brake_reuss_beam", "response_controlled.csv")
    hung, hung_model = load(chosen.data / "suspended_beam", "lock_in_stepped_sine.csv")
    free = ("force_gain", "instrument_phase")
    for name, data, model, freed in (
        ("brake_reuss", brake, brake_model, ()),
        ("suspended", hung, hung_model, free),
    ):
        begin = time.perf_counter()
        fit = sj.fit_jointly(data, model.modes, free=freed)
        describe(name, fit, time.perf_counter() - begin)
    held_out(brake, brake_model)
    halves(hung, hung_model, free)


if __name__ == "__main__":
    main()
