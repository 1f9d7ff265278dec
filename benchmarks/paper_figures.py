"""Figures 7, 8, 10 and 11 of the method paper anew: two beams identified, and responses predicted.

Run: OMP_NUM_THREADS=1 python benchmarks/paper_figures.py [--write]

Kwarta and Allen, section 3: the flat beam (Tabs. 1, 2 and A.1) and the curved one (Tabs. 3 and 4,
in the reading that is monostable: three times the printed cubic coefficient). As there, states are
recorded near resonance only, at the appropriation indicators of Eq. (20) that the paper prints,
the backbone is identified from them, and responses at the paper's forces are predicted. Truth is
the conservative nonlinear normal mode and the forced response by harmonic balance with nine
harmonics, as in the paper. The paper prints no number of a curve, so that only the forces and the
ranges of the indicator can be taken over.

Lines: `states` and `points` of each beam (figures 7 and 10), its `mode`, `response` and `predicted`
curves by force (8 and 11; thinned along their length), `resonance` by force, the identified
`damping` 2ζ̃ω̃ (1/s) by the measure of amplitude (Appendix B), and `errors` of the backbone where a
point is drawn over v·ω̃/Ω and, as in the paper, over the measured velocity. Errors of the flat beam
leave out 87.3 to 90.4 Hz, where an internal resonance 1:5 leaves the backbone. Indicators are those
of the fundamental. `from_rest`: far below resonance prediction has a small branch that the curve of
harmonic balance, which is one connected curve, has not; SciPy integrates the beam from rest there,
and the velocities of its first and second harmonic are told, and how far one period is from others.
"""

from typing import Any

import numpy as np
from harness import options, teller
from scipy.integrate import solve_ivp

import snrmjax as sj

tell = teller(__file__)
HERTZ = 2 * np.pi
DRAWN = 110  # points of a drawn curve
# Forces in N, and the appropriation indicators between which states are recorded (the paper's,
# section 3). Where the curved beam is softest the stable side changes, and states lie close to
# resonance there, as the paper's do.
FLAT_TEST = [(np.linspace(1.0e-3, 1.45e-2, 16), (0.5, 0.7))]
CURVED_TEST = [
    (np.linspace(5e-6, 1.8e-4, 12), (0.7842, 0.997)),
    (np.linspace(1.85e-4, 2.2e-4, 24), (0.997, 0.999997)),
    (np.linspace(2.25e-4, 3.0e-4, 7), (0.98, 0.9999)),
    (np.geomspace(3.3e-4, 2e-3, 10), (0.7842, 0.997)),
]
BEAMS: dict[str, dict[str, Any]] = {
    "flat": {
        **{"model": sj.model.flat_beam(), "test": FLAT_TEST, "forces": sj.model.FLAT_BEAM_FORCES},
        **{"low": 60.0, "high": 110.0, "mode_to": 105.0, "left_out": (87.3, 90.4)},
    },
    "curved": {
        **{"model": sj.model.curved_beam(), "test": CURVED_TEST},
        **{"forces": sj.model.CURVED_BEAM_FORCES, "left_out": (0.0, 0.0)},
        **{"low": 25.0, "high": 140.0, "mode_to": 125.0},
    },
}


def recorded(beam: dict[str, Any]) -> sj.measure.SteadyStates:
    """Two steady states a level of a virtual phase-resonance test."""
    parts, levels = [], 0
    for forces, indicator in beam["test"]:
        part = sj.phase_resonance_test(
            *(beam["model"], forces.tolist(), beam["low"] * HERTZ, beam["high"] * HERTZ),
            **{"appropriation": indicator, "points_per_level": 2},
            recording=sj.simulate.Recording(keep_harmonics=tuple(range(2, 10))),
        )
        parts.append(part.steady_states.renumbered(levels))
        levels += len(forces)
    return sj.measure.join_steady_states(*parts)


def thinned(frequency: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Places of the points that are spread along a curve."""
    height = np.abs(velocity) / np.abs(velocity).max()
    way = np.hypot(np.diff(frequency) / np.ptp(frequency), np.diff(height))
    length = np.concatenate([[0.0], np.cumsum(way)])
    wanted = np.linspace(0.0, length[-1], DRAWN)
    return np.unique(np.searchsorted(length, wanted).clip(0, len(length) - 1))


def tell_curve(name: str, beam: str, frequency: Any, velocity: Any, **further: Any) -> None:
    """A curve as it is drawn: frequency (rad/s) and velocity phasor (m/s) at midspan."""
    frequency, velocity = np.asarray(frequency), np.asarray(velocity)
    kept = thinned(frequency, velocity)
    tell(
        curve=name,
        beam=beam,
        frequency_hz=frequency[kept] / HERTZ,
        velocity=np.abs(velocity[kept]),
        **{
            key: np.asarray(value)[kept] if np.size(value) == len(frequency) else value
            for key, value in further.items()
        },
    )


def backbone_errors(points: Any, mode: Any, left_out: tuple[float, float]) -> dict[str, float]:
    """Relative errors of natural frequencies where the mode has the points' amplitudes.

    Over the velocity the curved beam's mode turns back: of its frequencies at one velocity the
    nearest counts.
    """
    amplitude = np.abs(mode.velocity[:, 1, 0])
    if points.argument == "displacement":
        amplitude = amplitude / mode.frequency

    def kept(frequency: np.ndarray) -> np.ndarray:
        return (frequency < left_out[0] * HERTZ) | (frequency > left_out[1] * HERTZ)

    on_mode, error = kept(mode.frequency), []
    amplitude, frequency = amplitude[on_mode], mode.frequency[on_mode]
    for size, natural in zip(points.amplitude, np.asarray(points.natural_frequency), strict=True):
        if kept(natural):
            away = amplitude - size
            at = np.flatnonzero(away[1:] * away[:-1] <= 0)
            fraction = away[at] / (away[at] - away[at + 1])
            there = frequency[at] + fraction * (frequency[at + 1] - frequency[at])
            error.append(np.min(np.abs(natural / there - 1)))
    return {"median": np.median(error), "largest": np.max(error), "points": len(error)}


def tell_from_rest(force: float, hertz: float) -> None:
    """Where the curved beam settles under a force that grows from nothing (Tab. 4)."""
    modes, drive = BEAMS["curved"]["model"].modes, hertz * HERTZ
    natural, per_newton = 64.78 * HERTZ, float(modes.participation[0])
    periods, kept, each = 160, 20, 256

    def rates(time: float, state: np.ndarray) -> list[float]:
        q, v = state
        elastic = natural**2 * q - 3.4380e9 * q**2 + 3 * 6.2183e12 * q**3
        grown = force * min(time * hertz / 40, 1.0)
        return [v, per_newton * grown * np.cos(drive * time) - 0.1 * natural * v - elastic]

    times = np.arange(kept * each) / (each * hertz) + (periods - kept) / hertz
    found = solve_ivp(rates, (0, periods / hertz), [0, 0], "DOP853", times, rtol=1e-9, atol=1e-16)
    cycles = (found.y[1] * float(np.ravel(modes.mode_shape)[0])).reshape(kept, each)
    harmonics = 2 * np.abs(np.fft.rfft(cycles, axis=1)) / each
    tell(
        from_rest=force,
        beam="curved",
        frequency_hz=hertz,
        velocity=harmonics[0, 1:3],
        repeats_within=float(np.ptp(cycles, axis=0).max() / np.ptp(cycles)),
    )


def run(name: str, beam: dict[str, Any]) -> None:
    """All lines of a beam."""
    model, forces = beam["model"], beam["forces"]
    states = recorded(beam)
    found = sj.identify_backbone(states, model.modes)
    points = found.points
    mode = sj.nonlinear_normal_mode(model, beam["mode_to"] * HERTZ)
    velocity = np.asarray(states.velocity)[:, 0]
    tell(
        curve="states",
        beam=name,
        frequency_hz=np.asarray(states.frequency) / HERTZ,
        velocity=np.abs(velocity),
        phase_deg=np.degrees(np.angle(velocity)),
        indicator=np.cos(np.angle(velocity)) ** 2,
    )
    tell(
        curve="points",
        beam=name,
        natural_frequency_hz=np.asarray(points.natural_frequency) / HERTZ,
        damping_ratio=np.asarray(points.damping_ratio),
        velocity=np.asarray(points.backbone_velocity),
    )
    tell_curve("mode", name, mode.frequency, mode.velocity[:, 1, 0])
    as_drawn = sj.identify.identify_points(states, model.modes, amplitude="velocity")
    for over, those in (("v ω̃/Ω", points), ("v, as in the paper", as_drawn)):
        tell(
            errors="backbone",
            beam=name,
            over=over,
            **backbone_errors(those, mode, beam["left_out"]),
        )
    linear = 2 * float(model.modes.damping_ratio[0] * model.modes.natural_frequency[0])
    for measure in ("fundamental", "peak"):
        those = sj.identify.identify_points(states, model.modes, measure=measure)
        damping = np.asarray(those.modal_damping)
        tell(
            damping=measure,
            beam=name,
            linear=linear,
            at_largest=float(damping[np.asarray(those.amplitude).argmax()]),
            range=[damping.min(), damping.max()],
        )
    low, high = beam["low"] * HERTZ, beam["high"] * HERTZ
    for exact in sj.forced_response(model, forces, low, high):
        force, at_midspan = float(exact.force), exact.velocity[:, 1, 0]
        phase = np.degrees(np.angle(at_midspan))
        tell_curve(
            *("response", name, exact.frequency, at_midspan),
            **{"force": force, "phase_deg": phase, "stable": np.asarray(exact.is_stable)},
        )
        for told in sj.identify.predict_response(
            found.backbone, model.modes, force, from_frequency=low
        ):
            phase = np.degrees(np.angle(told.velocity))
            tell_curve(
                *("predicted", name, told.frequency, told.velocity),
                **{"force": force, "phase_deg": phase, "stable": np.asarray(told.stable)},
            )
        (peak,) = sj.identify.resonances(found.backbone, model.modes, force)
        k = exact.at_events("phase_resonance")[-1]
        tell(
            resonance=force,
            beam=name,
            frequency_hz=[peak.frequency / HERTZ, exact.frequency[k] / HERTZ],
            velocity=[peak.velocity, abs(at_midspan[k])],
            frequency_error=peak.frequency / float(exact.frequency[k]) - 1,
            velocity_error=peak.velocity / float(abs(at_midspan[k])) - 1,
        )


if __name__ == "__main__":
    chosen = options(__doc__, only=list(BEAMS)).only
    for name in chosen:
        run(name, BEAMS[name])
        if name == "curved":
            tell_from_rest(BEAMS[name]["forces"][1], 35.0)
