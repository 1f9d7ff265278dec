"""Seconds of a curve of events over the force, beside as many responses and another formulation.

Run: OMP_NUM_THREADS=1 python benchmarks/event_curves.py

The flat beam with nine harmonics (77 unknowns with the frequency): folds, peaks and phase
resonances over the force. "responses" is the other way to know them: forced responses at 100
forces, events located, without stability. "extended" traces folds with the null vector as further
unknowns, R = 0, ∂R/∂x φ = 0, φ·φ = 1 (Seydel 2010, section 5.4), by the same continuation. The
coupled pair and the curved beam have curves of Neimark-Sacker points and of period doublings,
beside responses at 100 forces with stability. All take turns; times are medians of warm runs.
`largest_difference` is that of the frequencies at which both have an event, relative, the curve's
solved for at the forces of some of the responses.
"""

import jax
import jax.numpy as jnp
import numpy as np
from harness import medians, options, seconds_of, teller

import snrmjax as sj
from snrmjax.model.builders.beams import (
    CURVED_BEAM_FORCES,
    FLAT_BEAM_FORCES,
    curved_beam,
    flat_beam,
)
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.continuation.continuation import CurveRange, on_host, trace_curve
from snrmjax.simulate.continuation.event_equations import bordered
from snrmjax.simulate.solutions import event_curves

tell = teller(__file__)

HERTZ = 2 * np.pi
RESPONSES, COMPARED = 100, 3


def coupled() -> sj.model.Structure:
    """Two modes, the second at twice the first's frequency."""
    modes = sj.model.linear_modes([2.0, 4.0], [0.01, 0.01], [[1.0, 0.0]], [1.0, 0.0])
    return sj.model.structure(modes, sj.model.polynomial_potential({"112": 0.5}, 2))


FLAT = (flat_beam, FLAT_BEAM_FORCES[-1], (0.1, 1.5), (60 * HERTZ, 115 * HERTZ), 9)
# Structure, force in N, range of the force over it, frequencies in rad/s, harmonics.
CASES = {
    "fold": FLAT,
    "peak": FLAT,
    "phase_resonance": FLAT,
    "neimark_sacker": (coupled, 0.4, (0.5, 2.5), (1.5, 2.5), 5),
    "period_doubling": (
        *(curved_beam, CURVED_BEAM_FORCES[1], (0.5, 1.5)),
        *((15 * HERTZ, 80 * HERTZ), 25),
    ),
}


@compiled
def extended(equations, start, ends, steps, up):
    """Folds with the null vector as further unknowns."""
    n = equations.balance.size

    def linearised(y):
        x, null, motion, value = y[:n], y[n : 2 * n], jnp.append(y[:n], y[-2]), y[-1]

        def residual(value):
            return equations.at(value).residual(motion)

        def singular(x, omega, value):
            balance = equations.at(value)
            motion = jnp.append(x, omega)
            return jax.jvp(balance.residual, (motion,), (jnp.append(null, 0.0),))[1]

        rest, jacobian = equations.at(value).linearised(motion)
        by_value = jax.jvp(residual, (value,), (jnp.ones(()),))[1]
        second = jax.jacfwd(singular, argnums=(0, 1, 2))(x, y[-2], value)
        by_x = jacobian[:, :n]
        rows = (
            (by_x, jnp.zeros((n, n)), jacobian[:, n:], by_value[:, None]),
            (second[0], by_x, second[1][:, None], second[2][:, None]),
            (jnp.zeros((1, n)), 2 * null[None], jnp.zeros((1, 2))),
        )
        matrix = jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])
        equation = singular(x, y[-2], value)
        return jnp.concatenate([rest, equation, (null @ null - 1.0)[None]]), matrix

    direction = jnp.zeros_like(start).at[-1].set(up)
    return trace_curve(linearised, start, direction, CurveRange(*ends), steps)


def by_extended(model, force, start, to):
    """The curve of folds both ways, as `follow_event` has it, without its turns."""
    equations, point = event_curves._problem(model, force, start, "fold", to, "force", None)
    n = equations.balance.size
    null = np.asarray(bordered(equations.balance.linearised(point[: n + 1])[1][:, :n]).right)
    start = np.concatenate([point[:n], null / np.linalg.norm(null), point[n:]])
    ends = np.array(to) / float(equations.parameter_scale)
    steps = event_curves.DEFAULT_STEPS
    return [on_host(extended(equations, start, ends, steps, np.array(up))) for up in (1.0, -1.0)]


def largest_difference(model, kind, curve, responses, ends):
    """Of the events that some responses have and the curve's solution at their forces."""
    worst = 0.0
    for response in responses[:: max(len(responses) // COMPARED, 1)]:
        located = response.frequency[response.at_events(kind)]
        for near in curve.near(response.force):
            if not (ends[0] < near[1] < ends[1] and located.size):
                continue
            to = (response.force, 1.001 * response.force)
            again = sj.simulate.follow_event(model, response.force, near, kind=kind, to=to)
            k = np.argmin(np.abs(again.value - response.force))
            worst = max(worst, float(np.min(np.abs(located / again.frequency[k] - 1))))
    return worst


def main(rounds: int) -> None:
    """One line a case."""
    for kind, (build, force, fraction, ends, order) in CASES.items():
        model, to = build(), (fraction[0] * force, fraction[1] * force)
        stability = kind in ("neimark_sacker", "period_doubling")
        settings = {"harmonic_order": order, "stability": stability}
        (first, *_) = sj.forced_response(model, [force], *ends, **settings)
        start = first.point(first.at_events(kind)[0])
        forces = np.linspace(*to, RESPONSES)

        def follow(model=model, force=force, start=start, kind=kind, to=to):
            return sj.simulate.follow_event(model, force, start, kind=kind, to=to)

        def respond(model=model, forces=forces, ends=ends, settings=settings):
            return sj.forced_response(model, forces, *ends, **settings)

        compile_s, curve = seconds_of(follow)
        responses = respond()
        ways = {"curve": follow, "responses": respond}
        if kind == "fold":
            by_extended(model, force, start, to)
            ways["extended"] = lambda m=model, f=force, s=start, t=to: by_extended(m, f, s, t)
        times = medians(rounds, **ways)
        tell(
            kind=kind,
            model=model.name,
            unknowns=curve.coefficients[0].size + 1,
            device=jax.devices()[0].device_kind,
            points=len(curve.frequency),
            solves=curve.n_solves,
            turns=[name for name in curve.event if name],
            first_call_s=compile_s,
            seconds=times["curve"],
            seconds_per_100_points=100 * times["curve"] / len(curve.frequency),
            seconds_of_100_responses=times["responses"],
            seconds_extended=times.get("extended"),
            largest_difference=largest_difference(model, kind, curve, responses, ends),
        )


if __name__ == "__main__":
    main(options(__doc__, rounds=5).rounds)
