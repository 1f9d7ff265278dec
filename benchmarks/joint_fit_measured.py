"""Joint fits of the two measured beams, judged by levels that were left out of them.

Run: python benchmarks/joint_fit_measured.py --data FOLDER

FOLDER holds `brake_reuss_beam` and `suspended_beam` with a CSV and a `model.toml` each.

Brake-Reuss beam: fitted to six of its eight levels, each pair of levels predicted in turn; the
velocity and frequency at phase resonance under the force of a left-out level are compared with
that level's own states, interpolated to resonance. Suspended beam: force gain and phase free;
frequency and damping from zero to the largest velocity; two halves of the levels fitted
separately, compared in units of their bands. Both: whitened residuals and the notes of the fit.
Then speed: a fit of all 328 points; `scipy.optimize.least_squares` with finite differences on the
same residuals, and the fit's own solver from the same start; the derivative of the fitted curves
by every measurement. One JSON line each.
"""

import argparse
import itertools
import json
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.optimize import least_squares

import snrmjax as sj
from snrmjax.identify.joint.family_fit import MOST_STEPS, SOLVER
from snrmjax.identify.joint.free_unknowns import corrected_residuals
from snrmjax.numerics.compiled import compiled

HERTZ = 2 * np.pi


def tell(**fields: object) -> None:
    """One JSON line."""
    print(json.dumps({"benchmark": "joint_fit_measured", **fields}, default=_plain), flush=True)


def _plain(value: object) -> object:
    array = np.asarray(value)
    return [float(f"{x:.4g}") for x in array.reshape(-1)] if array.ndim else float(f"{array:.4g}")


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
        notes=[str(note) for note in fit.notes],
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
        notes=[[str(note) for note in fit.notes] for fit in fits],
    )


@compiled
def _residuals(vector, unravel, problem):
    return corrected_residuals(vector, unravel, problem)


@compiled
def _solve(vector, unravel, problem, unit):
    return optx.least_squares(
        lambda y, _: corrected_residuals(y * unit, unravel, problem),
        *(SOLVER, vector / unit),
        max_steps=MOST_STEPS,
    ).value * unit  # fmt: skip


def speed(data: sj.measure.SteadyStates, model: sj.model.Structure) -> None:
    """A fit with given families, SciPy on the same residuals, and all derivatives."""
    settings = {"backbone": "spline:6@displacement", "damping": "spline:5@displacement"}

    def fit_once() -> sj.identify.JointFit:
        return sj.fit_jointly(data, model.modes, **settings)

    fit = fit_once()
    vector, unravel = fit.vector()
    given = (unravel, fit.problem)
    unit = np.sqrt(np.diag(fit.covariance))

    def residuals(y: np.ndarray) -> np.ndarray:
        return np.asarray(_residuals(jnp.asarray(vector + y * unit), *given))

    start = np.zeros(len(vector))
    start[:11] = 5.0  # standard deviations away in every parameter of both curves
    residuals(start)

    def solve() -> np.ndarray:
        near = jnp.asarray(vector + start * unit)
        return np.asarray(_solve(near, *given, jnp.asarray(100.0 * unit)))

    found, best = (solve() - vector) / unit, least_squares(residuals, start, x_scale=1.0)
    times: dict[str, list[float]] = {"fit": [], "solver": [], "scipy": []}
    for _ in range(5):
        for name, work in (
            ("fit", fit_once),
            ("solver", solve),
            ("scipy", lambda: least_squares(residuals, start, x_scale=1.0)),
        ):
            begin = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - begin)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    tell(
        measurement="speed",
        points=len(fit.data.level),
        unknowns=len(vector),
        of_curves=11,
        **{f"{k}_seconds": v for k, v in medians.items()},
        scipy_over_fit=medians["scipy"] / medians["fit"],
        scipy_over_solver=medians["scipy"] / medians["solver"],
        derivatives_over_fit=medians["derivatives"] / medians["fit"],
        # Both ends of the two: SciPy stops where its cost falls by less than 1e-8.
        solver_cost_over_scipys_less_one=np.sum(residuals(found) ** 2) / (2 * best.cost) - 1,
        solver_and_scipy_apart_in_std=np.max(np.abs(found - best.x)),
        scipy_steps=best.nfev,
    )


def main() -> None:
    """Both beams, then the speed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    chosen = parser.parse_args()
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
    speed(brake, brake_model)
    held_out(brake, brake_model)
    halves(hung, hung_model, free)


if __name__ == "__main__":
    main()
