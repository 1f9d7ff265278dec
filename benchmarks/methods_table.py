"""All methods that read a table of steady states, on the same virtual tests: errors and coverage.

Run: python benchmarks/methods_table.py [--seeds 20] [--structure flat|duffing|quadratic|curved|
bolted|stop|two_modes]

Stepped sines by harmonic balance from both sides to resonance and past it, four levels of force,
12 states a level within 75° of resonance, as far as a test can hold them. Three steps of noise:
amplitude and phase errors of each state of 0.1 % and 0.1°, 0.5 % and 0.5°, 2 % and 2°, stated. The
truth is the phase resonance of 96 exact response curves (frequency, velocity, force), which no
method has seen: damping there by the balance of power of the fundamental. Their forces lie dense
where the curves bend, at the onset of slip or contact: a spline through 16 would be wrong there by
6 % of the damping, more than any method. Where a second mode lies
near (two_modes: 50 and 53 Hz) a resonance is not of one mode, and the truth is the damped
nonlinear mode.

One JSON line a structure, noise and method: median and 90th percentile of the relative errors of
frequency and damping at the method's own points between the lowest and the highest resonance,
share of points whose 95 % band holds the truth (of those with a band), points, and the share of
tests in which the method found nothing.
"""

import numpy as np
from harness import options, teller
from scipy.interpolate import CubicSpline, PchipInterpolator

import snrmjax as sj
from snrmjax.methods import METHODS, compare_methods
from snrmjax.simulate.virtual_test.recording import MeasurementErrors, Recording

tell = teller(__file__)

HERTZ = 2 * np.pi
_CURVES, _ROUNDS = 16, 6  # exact responses that tell the truth
_FREQUENCY = 20.0  # times as much as errors of damping, errors of frequency count
NOISE = {"low": (0.001, 0.1), "middle": (0.005, 0.5), "high": (0.02, 2.0)}  # relative, degrees


def _one_mode(effects=()):
    modes = sj.model.linear_modes([50 * HERTZ], [0.01], [[1.0]], [1.0])
    potential = sj.model.polynomial_potential({"1111": 2.5e8}, 1)
    return sj.model.structure(modes, potential, effects=effects)


def _effect(kind, **numbers):
    return [sj.model.EFFECTS[kind](**numbers)]


def _two_modes():
    modes = sj.model.linear_modes(
        [50 * HERTZ, 53 * HERTZ], [0.004, 0.006], [[1.0, 0.6]], [1.0, 0.6]
    )
    potential = sj.model.polynomial_potential({"1111": 2.5e8}, 2)
    return sj.model.structure(modes, potential)


STRUCTURES = {
    "flat": (sj.model.flat_beam, (2.669e-3, 4.448e-3, 8.896e-3, 1.334e-2), 60.0, 120.0),
    "duffing": (_one_mode, (1.0, 2.0, 4.0, 6.0), 45.0, 62.0),
    "quadratic": (
        lambda: _one_mode([sj.model.EFFECTS["quadratic_damping"](coefficient=10.0)]),
        *((2.0, 4.0, 8.0, 14.0), 45.0, 62.0),
    ),
    # Its softening part: beyond, three amplitudes of the backbone have one velocity.
    "curved": (sj.model.curved_beam, (3e-5, 6e-5, 9e-5, 1.2e-4), 50.0, 80.0),
    "bolted": (
        lambda: _one_mode(_effect("jenkins_slider", stiffness=6e3, slip_displacement=2e-4)),
        *((0.25, 0.5, 1.0, 2.0), 42.0, 60.0),
    ),
    "stop": (
        lambda: _one_mode(_effect("one_sided_stop", stiffness=1e4, gap=3e-4)),
        *((0.25, 0.5, 1.0, 2.0), 45.0, 62.0),
    ),
    "two_modes": (_two_modes, (0.25, 0.5, 1.0, 1.5), 46.0, 52.5),
}


def truth(model, forces, low, high):
    """Velocity, frequency and damping ratio at the phase resonances of exact curves."""
    rows = []
    more = np.geomspace(forces[0] / 2, forces[-1] * 1.2, _CURVES)
    for _ in range(_ROUNDS):
        rows = sorted(rows + _resonances(model, more, low, high))
        more = _where_it_bends(np.array(rows).T)
    return np.array(rows).T[:3]


def _resonances(model, forces, low, high):
    """Velocity, frequency, damping ratio and force at the phase resonance of each force."""
    rows = []
    modes = model.modes
    per_force = float(modes.mode_shape[0, 0] * modes.participation[0])
    for curve in sj.forced_response(model, np.sort(forces), low, high, stability=False):
        for k in curve.at_events("phase_resonance")[:1]:
            speed, omega = abs(curve.velocity[k, 1, 0]), float(curve.frequency[k])
            force = float(curve.force)
            rows.append((speed, omega, per_force * force / speed / (2 * omega), force))
    return rows


def _where_it_bends(rows):
    """Forces in the middle of the intervals in which the laws differ most from straight lines."""
    square = rows[0] ** 2
    middle = (square[1:] + square[:-1]) / 2
    roughness = np.zeros(len(middle))
    for values, weight in ((rows[1], _FREQUENCY), (rows[2], 1.0)):
        straight = (values[1:] + values[:-1]) / 2
        curved = PchipInterpolator(square, values)(middle)
        roughness = np.maximum(roughness, weight * np.abs(curved / straight - 1))
    chosen = np.argsort(-roughness)[:_CURVES]
    return (rows[3, chosen] + rows[3, chosen + 1]) / 2


def true_mode(model, forces, low, high):
    """The same of the damped nonlinear mode, up to the largest velocity of the test."""
    curve = sj.forced_response(model, forces[-1:], low, high, stability=False)[0]
    largest = float(np.max(np.abs(curve.velocity[:, 1, 0])))
    found = sj.simulate.damped_normal_mode(model, largest)
    speed = np.abs(found.velocity[:, 1, 0])
    kept = speed > largest / 50
    return np.stack([speed, found.frequency, found.damping_ratio])[:, kept]


Row = tuple[float, float, float, float]  # errors of frequency and damping, relative and over 1σ


def scored(one: object, true: np.ndarray, laws: list) -> list[Row]:
    """Errors of a method's points between the lowest and the highest true resonance."""
    at = np.asarray(one.velocity)
    good = one.has_result & (at >= true[0, 0]) & (at <= true[0, -1])
    omega, ratio = np.sqrt(laws[0](at[good] ** 2)), laws[1](at[good] ** 2)
    off = np.asarray(one.natural_frequency)[good] - omega
    away = np.asarray(one.damping_ratio)[good] - ratio
    stds = [np.asarray(s)[good] for s in (one.natural_frequency_std, one.damping_ratio_std)]
    return list(zip(off / omega, away / ratio, off / stds[0], away / stds[1], strict=True))


def line_of(rows: list[Row], seeds: int) -> dict[str, float | None]:
    """Errors and coverage of all points of all tests."""
    if not rows:
        return {}
    line: dict[str, float | None] = {}
    each = np.abs(np.array(rows))
    for k, quantity in enumerate(("frequency", "damping")):
        line[f"{quantity}_error_median"] = float(np.median(each[:, k]))
        line[f"{quantity}_error_90"] = float(np.percentile(each[:, k], 90))
        score = each[np.isfinite(each[:, k + 2]), k + 2]
        line[f"{quantity}_coverage"] = float(np.mean(score <= 1.96)) if score.size else None
    return line | {"points_a_test": len(rows) / seeds}


def truth_of(name: str) -> tuple[object, list, np.ndarray, list]:
    """The structure of a name, its forces, true resonances, and the laws through them."""
    make, forces, *ends = STRUCTURES[name]
    model = make()
    exact = true_mode if name == "two_modes" else truth
    true = exact(model, forces, *(HERTZ * end for end in ends))
    return model, forces, true, [CubicSpline(true[0] ** 2, v) for v in (true[1] ** 2, true[2])]


def main() -> None:
    """Print a line for every structure, noise and method."""
    given = options(__doc__, seeds=20, structure=list(STRUCTURES))
    for name in given.structure:
        model, forces, true, laws = truth_of(name)
        for noise, (amplitude, degrees) in NOISE.items():
            errors = MeasurementErrors(amplitude=amplitude, phase=np.radians(degrees))
            found: dict[str, list[Row]] = {method: [] for method in METHODS}
            nothing = dict.fromkeys(METHODS, 0)
            for seed in range(given.seeds):
                test = sj.phase_resonance_test(
                    *(model, forces, *(HERTZ * end for end in STRUCTURES[name][2:])),
                    appropriation=(np.cos(np.radians(75)) ** 2, 1.0),
                    points_per_level=12,
                    recording=Recording(errors, seed),
                )
                for one in compare_methods(test.steady_states, model.modes).results:
                    rows = scored(one, true, laws)
                    nothing[one.method] += not rows
                    found[one.method] += rows
            for method, rows in found.items():
                missed = nothing[method] / given.seeds
                about = {"structure": name, "noise": noise, "method": method}
                tell(**about, nothing_found=missed, **line_of(rows, given.seeds))


if __name__ == "__main__":
    main()
