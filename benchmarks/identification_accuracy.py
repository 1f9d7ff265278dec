"""How accurately points off resonance give the backbone, the resonances and the responses.

Run: python benchmarks/identification_accuracy.py [folder for figures]

Flat beam: states 25° to 65° off resonance only, no noise. Curved beam: states near resonance
through softening, minimum and stiffening. The reference is the nonlinear normal mode with 9
harmonics and the response by harmonic balance. One JSON line a beam and argument of the backbone.
"""

import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import snrmjax as sj
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

HERTZ = 2 * np.pi
TONGUE_HZ = (87.3, 90.4)  # where the flat beam's mode exchanges energy with its second one


def off_resonance(degrees_from: float, degrees_to: float) -> tuple[float, float]:
    """The range of the appropriation indicator between two phases."""
    return np.cos(np.radians(degrees_to)) ** 2, np.cos(np.radians(degrees_from)) ** 2


def flat_test() -> sj.measure.SteadyStates:
    """Twenty forces up to a little above the paper's largest, four states each."""
    return sj.phase_resonance_test(
        sj.model.flat_beam(),
        np.linspace(1.0e-3, 1.45e-2, 20).tolist(),
        55 * HERTZ,
        115 * HERTZ,
        appropriation=off_resonance(25, 65),
        points_per_level=4,
    ).steady_states


def curved_test() -> sj.measure.SteadyStates:
    """Forces from softening to stiffening, in finer steps and nearer to resonance at the minimum.

    The paper's test too went close to resonance where the stable side changes.
    """
    windows = [
        (np.linspace(5e-6, 1.8e-4, 16), off_resonance(3, 28)),
        (np.linspace(1.85e-4, 2.2e-4, 24), off_resonance(0.1, 3)),
        (np.linspace(2.25e-4, 3.0e-4, 9), off_resonance(0.5, 8)),
        (np.geomspace(3.3e-4, 2e-3, 12), off_resonance(3, 28)),
    ]
    parts = [
        sj.phase_resonance_test(
            sj.model.curved_beam(),
            forces.tolist(),
            25 * HERTZ,
            140 * HERTZ,
            appropriation=window,
            points_per_level=4,
        ).steady_states
        for forces, window in windows
    ]
    offsets = np.cumsum([0] + [len(forces) for forces, _ in windows[:-1]])
    numbered = [part.renumbered(int(offset)) for part, offset in zip(parts, offsets, strict=True)]
    return sj.measure.join_steady_states(*numbered)


def percent_errors(value: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Median and worst relative error in percent."""
    error = 100 * np.abs(value / truth - 1)
    return {"median_percent": float(np.median(error)), "worst_percent": float(error.max())}


def study(
    model: sj.model.Structure,
    data: sj.measure.SteadyStates,
    argument: str,
    branch: NormalModeBranch,
    responses: list[sj.simulate.ResponseCurve],
    skip_hz: tuple[float, float],
) -> tuple[dict, sj.identify.Backbone]:
    """Errors of points, curve, resonances and force balance against harmonic balance."""
    found = sj.identify_backbone(data, model.modes, amplitude=argument)
    points, backbone = found.points, found.backbone
    amplitude = np.abs(branch.velocity[:, 1, 0])
    if argument == "displacement":
        amplitude = amplitude / branch.frequency
    outside = (branch.frequency < skip_hz[0] * HERTZ) | (branch.frequency > skip_hz[1] * HERTZ)

    def truth(at: np.ndarray) -> np.ndarray:
        return np.interp(at, amplitude[outside], branch.frequency[outside])

    def kept(frequency: np.ndarray) -> np.ndarray:
        return (frequency < skip_hz[0] * HERTZ) | (frequency > skip_hz[1] * HERTZ)

    at, natural = np.asarray(points.amplitude), np.asarray(points.natural_frequency)
    use = kept(natural)
    grid = np.linspace(float(backbone.smallest), float(backbone.largest), 800)
    on_grid = np.asarray(backbone.natural_frequency(jnp.asarray(grid)))
    inside = kept(truth(grid))
    phase = np.degrees(np.angle(np.asarray(points.mode_velocity)))
    result: dict = {
        "beam": model.name,
        "argument": argument,
        "states": int(use.sum()),
        "phase_deg": [float(np.abs(phase).min()), float(np.abs(phase).max())],
        "points": percent_errors(natural[use], truth(at)[use]),
        "curve": percent_errors(on_grid[inside], truth(grid)[inside]),
        "resonances": [],
    }
    for curve in responses:
        exact = curve.at_events("phase_resonance")
        k = max(exact, key=lambda k: abs(curve.velocity[k, 1, 0]))
        predicted = max(
            sj.identify.resonances(backbone, model.modes, curve.force),
            key=lambda r: -abs(r.frequency - curve.frequency[k]),
            default=None,
        )
        balance = force_error(backbone, curve)
        size = np.abs(curve.velocity[:, 1, 0])
        high = size > 0.3 * size.max()
        result["resonances"].append(
            {
                "force_n": curve.force,
                "velocity_error_percent": None
                if predicted is None
                else 100 * (predicted.velocity / abs(curve.velocity[k, 1, 0]) - 1),
                "frequency_error_percent": None
                if predicted is None
                else 100 * (predicted.frequency / curve.frequency[k] - 1),
                "force_balance_worst_percent": 100 * float(balance[high].max()),
                "force_balance_outside_tongue_percent": 100
                * float(balance[high & kept(curve.frequency)].max()),
            }
        )
    return result, backbone


def force_error(backbone: sj.identify.Backbone, curve: sj.simulate.ResponseCurve) -> np.ndarray:
    """Relative error of the force that the backbone needs for the exact response."""
    velocity, frequency = np.abs(curve.velocity[:, 1, 0]), curve.frequency
    argument = velocity / frequency if backbone.argument == "displacement" else velocity
    at = jnp.asarray(argument)
    squared = np.asarray(backbone.squared_frequency(at))
    damping = np.asarray(backbone.modal_damping(at))
    dynamic = np.abs(squared - frequency**2 + 1j * frequency * damping)
    force = dynamic * velocity / frequency / abs(float(backbone.modal_constant))
    return np.abs(force / curve.force - 1)


def main() -> None:
    """Run both beams and print."""
    flat, curved = sj.model.flat_beam(), sj.model.curved_beam()
    data = flat_test()
    branch = sj.nonlinear_normal_mode(flat, 105 * HERTZ)
    responses = sj.forced_response(flat, sj.model.FLAT_BEAM_FORCES, 55 * HERTZ, 115 * HERTZ)
    for argument in ("displacement", "velocity"):
        result, _ = study(flat, data, argument, branch, responses, TONGUE_HZ)
        print(json.dumps(result))
    data = curved_test()
    branch = sj.nonlinear_normal_mode(curved, 125 * HERTZ)
    responses = sj.forced_response(curved, sj.model.CURVED_BEAM_FORCES, 25 * HERTZ, 140 * HERTZ)
    result, backbone = study(curved, data, "displacement", branch, responses, (0.0, 0.0))
    print(json.dumps(result))
    if len(sys.argv) > 1:
        folder = Path(sys.argv[1])
        folder.mkdir(parents=True, exist_ok=True)
        figure = sj.plot.response_figure(
            backbone,
            [
                part
                for force in sj.model.CURVED_BEAM_FORCES
                for part in sj.identify.predict_response(
                    backbone, curved.modes, force, from_frequency=25 * HERTZ
                )
            ],
            [
                r
                for f in sj.model.CURVED_BEAM_FORCES
                for r in sj.identify.resonances(backbone, curved.modes, f)
            ],
            simulated=responses,
        )
        sj.plot.save_figure(folder / "curved_responses.png", figure)


if __name__ == "__main__":
    main()
