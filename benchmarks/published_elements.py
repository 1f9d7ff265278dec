"""Published problems with elements at points, each number beside what its source prints.

Run: OMP_NUM_THREADS=1 python benchmarks/published_elements.py

Sources: NLvib's examples 1 to 5 and 8 to 11 (Krack and Gross; their numbers, or those of an
independent harmonic balance where none are printed), SSMTool's three oscillators, cantilevers,
Timoshenko and von Karman beams (spectral submanifolds of order 3, 7 and 11, collocation), closed
forms of a Jenkins element and of Segalman's four-parameter Iwan joint. `published` is what it is
held against, to the digits that are known (`published_sources.toml` says whether a source prints
it, a closed form or an independent program has it); `difference` is relative. Seconds are those of
the second run, programs compiled; of problem 11 the source has less than two minutes for its first
curve.

Problem 21, the Brake-Reuss beam, is left out: its contacts are rough surfaces, whose stiffness
grows with the pressure as asperities close, for which there is no element here.
"""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial

import jax.numpy as jnp
import numpy as np
from harness import options, seconds_of, teller
from timoshenko_beam import timoshenko_beam

import snrmjax as sj
from snrmjax.simulate.continuation.continuation import StepControl

tell = teller(__file__)
Rows = Iterator[tuple[str, float, float]]  # quantity, found, published
LONG = StepControl(max_points=4000)
FINE = StepControl(max_points=20000, largest=0.002)


def _element(kind: str, at: object, **parameters: float) -> sj.model.AbstractForce:
    return sj.model.make_effect(kind, parameters, at=at)


def _height(model: sj.model.Structure, motions: object, point: str) -> np.ndarray:
    """Amplitudes of the fundamental at a point, m."""
    x = motions.coefficients[:, 1:3] @ np.asarray(model.modes.shape_at(point))
    return np.hypot(x[:, 0], x[:, 1])


def _at_energy(branch: object, energy: float) -> float:
    return float(np.interp(np.log(energy), np.log(branch.energy), branch.frequency))


def _events(curves: list, kind: str) -> np.ndarray:
    return np.concatenate([c.frequency[c.at_events(kind)] for c in curves])


def _nearest(found: np.ndarray, wanted: float) -> float:
    return float(found[np.argmin(np.abs(found - wanted))]) if len(found) else np.nan


def _duffing() -> Rows:
    spring = _element("cubic_stiffness", "x1", coefficient=0.1)
    model = sj.model.from_matrices([[1.0]], [[0.05]], [[1.0]], force="x1", effects=spring)
    for order, folds, peak in ((1, (1.26754, 1.11559), 2.84162), (7, (1.26960, 1.11570), 2.83019)):
        curve = sj.forced_response(model, 0.18, 0.5, 1.6, harmonic_order=order, steps=FINE)[0]
        for fold in folds:
            yield f"fold, H {order}", _nearest(_events([curve], "fold"), fold), fold
        yield f"largest amplitude, H {order}", float(_height(model, curve, "x1").max()), peak


def _two_cubic_springs() -> Rows:
    springs = (
        _element("cubic_stiffness", "x1", coefficient=1.0),
        _element("cubic_stiffness", sj.model.between("x1", "x2"), coefficient=0.0042),
    )
    chain = sj.model.chain([1.0, 0.05], [1.0, 0.0453, 0.0], [0.002, 0.013, 0.0])
    model = sj.model.from_matrices(*chain, force="x1", effects=springs)
    curves = sj.forced_response(model, 0.11, 0.8, 1.4, harmonic_order=7, steps=FINE)
    for fold in (1.21463, 1.20622):
        yield "fold", _nearest(_events(curves, "fold"), fold), fold
    for place in (1.11271, 1.19574):
        yield "Neimark-Sacker", _nearest(_events(curves, "neimark_sacker"), place), place
    amplitude = _height(model, curves[0], "x1")
    for low, high, peak in ((0.8, 1.12, 0.5918), (1.19, 1.4, 0.57847)):
        inside = (curves[0].frequency > low) & (curves[0].frequency < high)
        yield "largest amplitude", float(amplitude[inside].max()), peak


def _unilateral_spring() -> Rows:
    stop = _element("one_sided_stop", "x1", stiffness=100.0, gap=1.0)
    chain = sj.model.chain([1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.03, 0.03])
    model = sj.model.from_matrices(*chain, force="x2", effects=stop)
    curves = sj.forced_response(model, 0.1, 0.5, 0.8, harmonic_order=21, steps=FINE)
    x = curves[0].coefficients @ np.asarray(model.modes.shape_at("x1"))
    rms = np.sqrt(0.5 * np.sum(x**2, axis=1))  # the mean counts half, as the source has it
    yield "largest rms", float(rms.max()), 0.98093
    yield "its frequency", float(curves[0].frequency[np.argmax(rms)]), 0.7541
    yield "grazing, a fold", _nearest(_events(curves, "fold"), 0.6534401), 0.6534401
    touching = np.flatnonzero(np.diff(np.sign(_height(model, curves[0], "x1") - 1.0)))
    yield "grazing", float(curves[0].frequency[touching[0]]), 0.5818996


def _mode_of_two_masses() -> Rows:
    spring = _element("cubic_stiffness", "x1", coefficient=0.5)
    chain = sj.model.chain([1.0, 1.0], [1.0, 1.0, 1.0])
    model = sj.model.from_matrices(*chain, force="x1", effects=spring)
    first = sj.nonlinear_normal_mode(model, 1.37616, harmonic_order=9, steps=FINE, stability=False)
    keep = np.cumsum(first.frequency > 1.4) == 0  # before the tongue
    rising = dataclasses.replace(
        first, frequency=first.frequency[keep], energy=first.energy[keep], tongues=()
    )
    frequencies = (1.000933, 1.00895, 1.065728, 1.206856, 1.316432, 1.376155)
    for energy, published in zip((0.01, 0.1, 1, 10, 100, 1000), frequencies, strict=True):
        yield f"in phase at {energy} J", _at_energy(rising, energy), published
    swapped = sj.model.from_matrices(*chain, force="x1", effects=spring, mode_of_interest=1)
    second = sj.nonlinear_normal_mode(swapped, 3.3, harmonic_order=9, steps=FINE, stability=False)
    frequencies = (1.732231, 1.73387, 1.751563, 2.02933, 3.29435)
    for energy, published in zip((0.01, 0.1, 1, 10, 100), frequencies, strict=True):
        yield f"out of phase at {energy} J", _at_energy(second, energy), published


def _regularised_friction() -> Rows:
    friction = _element("regularised_friction", "x1", slip_force=5.0, velocity=0.05)
    chain = sj.model.chain([0.02, 1.0], [0.0, 40.0, 600.0])
    model = sj.model.from_matrices(*chain, force="x1", effects=friction)
    natural = np.asarray(model.modes.natural_frequency)
    yield "free, first", float(natural[0]), 24.15620
    yield "free, second", float(natural[1]), 45.34841
    shape = abs(float(np.max(np.abs(np.asarray(model.modes.mode_shape)[:, 0]))))
    mode = sj.simulate.damped_normal_mode(model, 10 * natural[0] * shape, harmonic_order=21)
    yield "small motions, stuck", float(mode.frequency[0]), 25.29822
    yield "large motions, free", float(mode.frequency[-1]), 24.15620


def _cubic_at_a_tip() -> Rows:
    area, second = 0.014**2, 0.014**4 / 12
    spring = _element("cubic_stiffness", "w19", coefficient=6e9)
    matrices = sj.model.beam(205e9 * second, 7800 * area, 0.7, 19)
    model = sj.model.from_matrices(
        *matrices, force="w19", effects=spring, n_modes=10, residuals=False, sensors=["w19"]
    )
    hertz = np.asarray(model.modes.natural_frequency) / (2 * np.pi)
    for found, published in zip(hertz, (23.6615, 148.284, 415.208), strict=False):
        yield "natural frequency, Hz", float(found), published
    mode = sj.nonlinear_normal_mode(
        model, 2 * np.pi * 47, harmonic_order=5, steps=FINE, stability=False
    )
    published = (1.148e-4, 4.962e-4, 1.478e-3, 3.643e-3, 9.97e-3, 2.208e-2, 4.61e-2)
    for frequency, energy in zip((24, 25, 27, 30, 35, 40, 45), published, strict=True):
        beyond = mode.frequency - 2 * np.pi * frequency
        first = int(np.argmax(beyond > 0))  # tongues pass the frequency again
        fraction = beyond[first - 1] / (beyond[first - 1] - beyond[first])
        steps = np.log(mode.energy[first - 1 : first + 1])
        yield f"energy at {frequency} Hz", float(np.exp(steps @ [1 - fraction, fraction])), energy


def _timoshenko_beam() -> Rows:
    alone, loaded = timoshenko_beam(), timoshenko_beam(mass=80.0)
    yield "natural frequency, rad/s", alone.modes.natural_frequency.item(0), 3.05
    sj.forced_response(alone, 2.4e6, 2.5, 3.9, harmonic_order=10, stability=False)
    first = loaded.modes.natural_frequency.item(0)
    yield "natural frequency with a mass, rad/s", first, 2.2562
    decay = first * loaded.modes.damping_ratio.item(0)
    yield "decay with a mass, 1/s", decay, 3.8056e-4
    curves = sj.forced_response(
        loaded, 8.4e5, 2.1, 2.7, harmonic_order=10, steps=LONG, stability=False
    )
    for fold in (2.4284, 2.3948):
        yield "fold", _nearest(_events(curves, "fold"), fold), fold


def _three_oscillators() -> Rows:
    springs = [
        _element("cubic_stiffness", sj.model.between(a, b), coefficient=1e-3)
        for a, b in (("x1", "x2"), ("x2", "x3"))
    ]
    damping = np.diag([5e-4, 1e-3, 1.5e-3])
    model = sj.model.from_matrices(np.eye(3), damping, np.eye(3), force="x1", effects=springs)
    curves = sj.forced_response(model, 5e-3, 0.995, 1.016, harmonic_order=5, steps=LONG)
    for fold in (1.0025, 1.0018, 1.0150, 1.0031):
        yield "fold", _nearest(_events(curves, "fold"), fold), fold
    yield "Neimark-Sacker", _nearest(_events(curves, "neimark_sacker"), 1.0021), 1.0021


def _cantilever_on_a_spring() -> Rows:
    matrices = sj.model.beam(
        *(45e6 * 10**4 / 12, 1780e-9 * 100, 2700.0, 40),
        springs={"w40": 27.0},
        stiffness_damping=2.5e-5,
        mass_damping=1.25e-4,
    )
    spring = _element("cubic_stiffness", "w40", coefficient=60.0)
    model = sj.model.from_matrices(
        *matrices, force="w40", effects=spring, n_modes=12, sensors=["w40"]
    )
    natural = np.asarray(model.modes.natural_frequency)
    for found, published in zip(natural, (15.603256, 46.576613, 123.774), strict=False):
        yield "natural frequency, rad/s", float(found), published
    # The force is along the first mode alone.
    along = jnp.asarray(np.eye(len(natural))[0] * natural[0] ** 2)
    model = dataclasses.replace(model, modes=dataclasses.replace(model.modes, participation=along))
    curves = sj.forced_response(model, 2e-3, 15.3, 15.9, harmonic_order=5, steps=LONG)
    for fold in (15.58314, 15.59292):
        yield "fold", _nearest(_events(curves, "fold"), fold), fold
    for place in (15.587, 15.590, 15.665, 15.863):
        yield "Neimark-Sacker", _nearest(_events(curves, "neimark_sacker"), place), place
    below = curves[0].frequency < 15.6
    yield "largest tip there", float(_height(model, curves[0], "w40")[below].max()), 0.16188


def _jenkins() -> Rows:
    slider = _element("jenkins_slider", "x1", stiffness=0.25, slip_displacement=0.8)
    model = sj.model.from_matrices([[1.0]], [[0.01]], [[0.75]], force="x1", effects=slider)
    mode = sj.simulate.damped_normal_mode(model, 4.0, harmonic_order=1, steps=FINE)
    amplitude = _height(model, mode, "x1")
    for x, frequency, damping in (
        (1.0, 0.982041, 0.031496),
        (1.6, 0.935414, 0.050818),
        (3.2, 0.893798, 0.042949),
    ):
        yield f"frequency at {x}", float(np.interp(x, amplitude, mode.frequency)), frequency
        yield f"damping at {x}", float(np.interp(x, amplitude, mode.damping_ratio)), damping


def _iwan() -> Rows:
    joint = _element(
        *("four_parameter_iwan", "x1"), slip_force=10.0, stiffness=0.6, exponent=-0.5, ratio=0.0
    )
    yield "displacement of macroslip", float(joint.end), 50.0
    angle = 2 * np.pi * np.arange(4096) / 4096
    for u in (0.1, 1.0, 10.0, 40.0):
        force = np.asarray(joint.cycle_force(jnp.asarray(u * np.cos(angle)), jnp.zeros(4096)))
        loss = float(np.sum(force * -u * np.sin(angle)) * angle[1])
        yield f"loss per cycle at {u}", loss, 0.045255 * u**2.5


def _friction_at_a_node() -> Rows:
    friction = _element("regularised_friction", "w3", slip_force=1.5, velocity=6e-7)
    mass, _, stiffness, points = sj.model.beam(185e9 * 0.1**3 * 0.3 / 12, 7830 * 0.03, 2.0, 8)
    held = [k for k, point in enumerate(points) if point != "w3"]
    stuck = sj.model.from_matrices(
        *(mass[np.ix_(held, held)], None, stiffness[np.ix_(held, held)]),
        *([points[k] for k in held],),
        force="w8",
    ).modes.natural_frequency.item(0)
    model = sj.model.from_matrices(
        *(mass, 0.02 / stuck * stiffness, stiffness, points), force="w8", effects=friction
    )
    (curve,) = sj.forced_response(model, 0.2, 110.0, 370.0, harmonic_order=7, stability=False)
    tip = curve.coefficients @ np.asarray(model.modes.shape_at("w8"))
    rms = np.sqrt(tip[:, 0] ** 2 + 0.5 * np.sum(tip[:, 1:] ** 2, axis=1))
    yield "largest rms at the tip", float(rms.max()), 6.70985e-8
    yield "its frequency, rad/s (printed to 3 digits)", float(curve.frequency[rms.argmax()]), 195.0


def _with_stretching(
    model: sj.model.Structure, axial: float, length: float, n_elements: int
) -> sj.model.Structure:
    """With V = E A (∫ w′² dx)² / 8 L, of a beam whose ends cannot come nearer.

    The axial motion follows without inertia: far below its first natural frequency.
    """
    h = length / n_elements
    slopes = np.array([[36, 3 * h, -36, 3 * h], [3 * h, 4 * h**2, -3 * h, -(h**2)]])
    slopes = np.vstack([slopes, -slopes[0], [3 * h, -(h**2), -3 * h, 4 * h**2]]) / (30 * h)
    names = [f"{kind}{k}" for k in range(n_elements + 1) for kind in "wr"]
    shapes = np.zeros((len(names), model.n_modes))
    for row, point in zip(np.asarray(model.modes.mode_shape), model.modes.sensors, strict=True):
        shapes[names.index(point)] = row
    squares = np.zeros((model.n_modes, model.n_modes))
    for k in range(n_elements):
        there = shapes[2 * k : 2 * k + 4]
        squares += there.T @ slopes @ there
    terms: Counter[tuple[int, ...]] = Counter()
    for i, j, m, n in itertools.product(range(model.n_modes), repeat=4):
        terms[tuple(sorted((i, j, m, n)))] += axial / (8 * length) * squares[i, j] * squares[m, n]
    potential = sj.model.polynomial_potential(dict(terms), model.n_modes)
    return dataclasses.replace(model, potential=potential)


def _von_karman_beam() -> Rows:
    mass, _, stiffness, points = sj.model.beam(
        *(45e6 * 10**4 / 12, 1780e-9 * 100, 2700.0, 100),
        supports=("clamped", "pinned"),
        springs={"w50": 37.0},
    )
    model = sj.model.from_matrices(
        *(mass, 2e-4 / 9 * stiffness, stiffness, points),
        **{"force": "w50", "n_modes": 8, "residuals": False},
    )
    model = _with_stretching(model, 45e6 * 100, 2700.0, 100)
    first = model.modes.natural_frequency.item(0)
    yield "natural frequency, rad/s", first, 33.196
    curves = sj.forced_response(
        model, 20.0, 0.96 * first, 1.05 * first, harmonic_order=5, steps=LONG
    )
    found = np.sort(_events(curves, "fold"))
    for fold, published in zip(found, (33.522, 33.523), strict=False):
        yield "fold", float(fold), published
    places = _events(curves, "neimark_sacker")
    for place in (33.841, 34.028):
        yield "Neimark-Sacker", _nearest(places, place), place
    torus = sj.simulate.quasi_periodic_branch(model, curves[0])
    ends = (("begins", 0, 5.847), ("ends", -1, 5.519))
    for word, end, published in ends:
        yield f"slow period where the torus {word}, s", float(torus.slow_period[end]), published
    yield "end of the torus", float(torus.frequency[-1]), 34.028


def _subharmonic_of_a_beam() -> Rows:
    mass, damping, stiffness, points = sj.model.beam(
        *(1.0, 1.0, 2.0, 40), supports=("clamped", "pinned"), mass_damping=2e-3
    )
    model = sj.model.from_matrices(
        *(mass, damping, stiffness, points),
        **{"force": "w20", "n_modes": 6, "residuals": False},
    )
    # The force is along the second mode alone.
    along = dataclasses.replace(model.modes, participation=jnp.asarray(np.eye(6)[1]))
    model = _with_stretching(dataclasses.replace(model, modes=along), 1e-4, 2.0, 40)
    second = model.modes.natural_frequency.item(1)
    yield "natural frequency, rad/s", second, 12.4927
    curves = sj.forced_response(
        model, 40.0, 0.94 * second, 1.12 * second, harmonic_order=3, subharmonic=3
    )
    yield "fold, with the period of the force", float(_events(curves[:2], "fold")[0]), 12.607
    folds = np.sort(_events(curves[2:], "fold"))
    for fold, published in zip(folds, (11.805, 12.870, 13.008, 13.590, 13.653), strict=False):
        yield "fold of order 1/3", float(fold), published
    point = _nearest(_events(curves[2:], "neimark_sacker"), 13.216)
    yield "Neimark-Sacker of order 1/3", point, 13.216


def _isola_of_negative_damping() -> Rows:
    elements = (
        _element("cubic_stiffness", "w25", coefficient=6.0),
        _element("cubic_damping", "w25", coefficient=-0.02),
    )
    matrices = sj.model.beam(
        *(45e6 * 1e4 / 12, 1780e-9 * 100, 2700.0, 25),
        mass_damping=1.25e-4,
        stiffness_damping=2.5e-4,
    )
    model = sj.model.from_matrices(
        *matrices, force="w25", effects=elements, n_modes=8, sensors=["w25"]
    )
    yield "natural frequency, rad/s", model.modes.natural_frequency.item(0), 7.000497
    yield "damping ratio", model.modes.damping_ratio.item(0), 8.840e-4
    settings = sj.simulate.ResponseSettings(harmonic_order=5, stability=False)
    for ratio, peak, at in (
        (1e-3, 0.010118, 7.00077),
        (1.7e-3, 0.020736, 7.00165),
        (1.8e-3, 0.0252, 7.00219),
    ):
        main = sj.forced_response(model, 0.1 * ratio, 6.95, 7.05, harmonic_order=5, stability=False)
        tip = _height(model, main[0], "w25")
        yield f"largest tip at {ratio}", float(tip.max()), peak
        yield f"its frequency at {ratio}, rad/s", float(main[0].frequency[tip.argmax()]), at
        apart = sj.simulate.isolated_responses(
            model, 0.1 * ratio, 6.95, 7.05, known=main, settings=settings
        )
        yield f"isolated responses at {ratio}", float(len(apart)), 1.0
        if ratio == 1e-3:
            loop, tip = apart[0], _height(model, apart[0], "w25")
            away = loop.frequency - 7.00426
            passed = np.flatnonzero(away[1:] * away[:-1] < 0)
            fraction = away[passed] / (away[passed] - away[passed + 1])
            crossed = np.sort(tip[passed] + fraction * (tip[passed + 1] - tip[passed]))
            for found, published in zip(crossed, (0.03926, 0.04355), strict=True):
                yield "tip of the isola at 7.00426", float(found), published
    joined = sj.forced_response(model, 1.9e-4, 6.95, 7.05, harmonic_order=5, stability=False)
    joined_tip = float(_height(model, joined[0], "w25").max())
    yield "joined at 1.9e-3 (1: beyond 0.05)", float(joined_tip > 0.05), 1.0


def _rubber_beam() -> Rows:
    slider = _element("jenkins_slider", "w5", stiffness=1e8, slip_displacement=106e-8)
    matrices = sj.model.beam(0.6725 * 210e9 * 0.06 * 0.05**3 / 12, 7850 * 0.05 * 0.06, 0.71, 14)
    model = sj.model.from_matrices(*matrices, force="w14", effects=slider)
    hertz = 2 * np.pi
    for found, published in zip(
        np.asarray(model.modes.natural_frequency) / hertz, (67.960, 425.903, 1192.61), strict=False
    ):
        yield "free frequency, Hz", float(found), published
    for speed, end, published in ((0.01, 0, 112.675), (30.0, -1, 67.960)):
        mode = sj.simulate.damped_normal_mode(model, speed, harmonic_order=7)
        yield f"damped mode to {speed:g} m/s, Hz", float(mode.frequency[end] / hertz), published


PROBLEMS: dict[str, Callable[[], Rows]] = {
    "1 Duffing": _duffing,
    "2 two masses, two cubic springs": _two_cubic_springs,
    "3 two masses, unilateral spring": _unilateral_spring,
    "4 normal modes of two masses": _mode_of_two_masses,
    "5 regularised friction, damped mode": _regularised_friction,
    "8 regularised friction at a node of a beam": _friction_at_a_node,
    "9 cubic spring at a tip": _cubic_at_a_tip,
    "11 Timoshenko beam of large rotations": _timoshenko_beam,
    "13 three oscillators, 1:1:1": _three_oscillators,
    "14 cantilever on a spring, 1:3": _cantilever_on_a_spring,
    "15 von Karman beam on a spring, 1:3": _von_karman_beam,
    "17 isola of negative damping": _isola_of_negative_damping,
    "18 Jenkins element, damped mode": _jenkins,
    "19 four-parameter Iwan joint": _iwan,
    "20 cantilever with a Jenkins element": _rubber_beam,
    "27 clamped-pinned beam, subharmonic 1:3": _subharmonic_of_a_beam,
}

if __name__ == "__main__":
    chosen = options(__doc__, only=["all"]).only
    for name, problem in PROBLEMS.items():
        if "all" not in chosen and name.split()[0] not in chosen:
            continue
        list(problem())
        seconds, rows = seconds_of(partial(list, problem()))
        for quantity, found, published in rows:
            tell(
                problem=name,
                quantity=quantity,
                found=f"{found:.7g}",
                published=f"{published:.7g}",
                difference=found / published - 1,
            )
        tell(problem=name, seconds=seconds)
