"""Responses that a window of frequencies hides: their folds lie beyond its ends."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.simulate.balance.given_numbers import frequency_range
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import velocity_phasors
from snrmjax.simulate.continuation.curve_tracing import response_balances, trace_from_rest
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.continuation.stability import Stability, many_multipliers, stability_of
from snrmjax.simulate.solutions.forced_response import DEFAULT_SETTINGS, ResponseSettings


class HiddenBranch(NamedTuple):
    """A stable response at an end of a window that no curve traced within the window passes."""

    at_frequency: float  # rad/s, the end of the window
    to_frequency: float  # rad/s, where it folds or leaves the window
    amplitude: Float[np.ndarray, " sensor"]  # m/s, fundamental at `at_frequency`
    found_from: float  # rad/s, the start from which a trace passes it


def hidden_branches(
    model: Structure,
    curves: Sequence[ResponseCurve],
    from_frequency: float,
    to_frequency: float,
    *,
    settings: ResponseSettings = DEFAULT_SETTINGS,
) -> list[HiddenBranch]:
    """Stable responses in a window that is too narrow for the folds that lead to them.

    The window is widened beyond each end, to half way (as a ratio) between the next resonance and
    the one behind it, and the curve is traced from there without stability: what of it passes the
    end elsewhere than the known curves is another branch. A branch that reaches into the window
    passes one of its ends, unless it is isolated (see `isolated_responses`).

    Arguments: `curves` known of one force, from `from_frequency` to `to_frequency` (rad/s).
    Returns the branches whose Floquet multipliers say that they are stable.
    """
    if not model.effects and not model.potential.monomials:
        return []
    ends = frequency_range(from_frequency, to_frequency)
    expanded = simulated_structure(model)
    force = np.array([curves[0].force])
    balance = response_balances(
        [expanded], force, settings.harmonic_order, settings.n_samples, ends
    )
    known = _known_at_ends(balance, curves, ends)
    found = []
    for begin, end in _starts_beyond(np.asarray(expanded.modes.natural_frequency), ends):
        wide, downward = np.sort([begin, ends[1 - end]]), end == 1
        (curve,) = trace_from_rest(
            balance, np.array([0]), wide, settings.steps, 1, downward=downward
        )
        points, unit = curve.points, float(balance.frequency_scale[0])
        for first, last in _passings(points, ends[end] / unit, known[end], downward):
            inside = points[first : first + 1]
            multipliers = many_multipliers(balance, np.array([0]), inside)
            if stability_of(multipliers)[0] != Stability.STABLE:
                continue
            motion, frequency = balance.motions(inside)
            velocity = velocity_phasors(motion, frequency, np.asarray(expanded.modes.mode_shape))
            reaches = float(np.clip(points[last, -1] * unit, *ends))
            amplitude = np.abs(velocity[0, 1])
            found.append(HiddenBranch(float(ends[end]), reaches, amplitude, float(begin)))
    return found


def _starts_beyond(
    natural: Float[np.ndarray, " mode"], ends: Float[np.ndarray, " end"]
) -> Iterator[tuple[float, int]]:
    """Frequencies beyond the ends (rad/s), away from the resonances, and which end each is for.

    Beyond the outermost resonances an octave takes the place of the ratio to the next one.
    """
    own = np.sort(natural[natural > 0])
    if not own.size:
        return
    below, above = own[own < ends[0]], own[own > ends[1]]
    lower = own[: max(below.size, 1)][-2:]
    upper = own[-max(above.size, 1) :][:2]
    begin = np.sqrt(lower[0] * lower[-1]) if lower.size > 1 else lower[0] / np.sqrt(2.0)
    if begin < ends[0]:
        yield float(begin), 0
    begin = np.sqrt(upper[0] * upper[-1]) if upper.size > 1 else upper[0] * np.sqrt(2.0)
    if begin > ends[1]:
        yield float(begin), 1


def _known_at_ends(
    balance: HarmonicBalance, curves: Sequence[ResponseCurve], ends: Float[np.ndarray, " end"]
) -> list[Float[np.ndarray, "curve unknown"]]:
    """Scaled coefficients of the curves where they begin or stop at each end of the window."""
    rows: list[list[np.ndarray]] = [[], []]
    for curve in curves:
        for k in (0, -1) if len(curve.frequency) else ():
            near = np.isclose(curve.frequency[k], ends, rtol=1e-9)
            for end in np.flatnonzero(near).tolist():
                rows[end].append(curve.coefficients[k].ravel())
    scale = float(balance.displacement_scale[0])
    return [np.array(r).reshape(-1, balance.size) / scale for r in rows]


def _passings(
    points: Float[np.ndarray, "point unknown"],
    end: float,
    known: Float[np.ndarray, "curve unknown"],
    downward: bool,
) -> Iterator[tuple[int, int]]:
    """First points inside the window after (or before) it is entered, and where each run ends.

    A passing within whose step a known curve lies is that curve's own.
    """
    side = points[:, -1] > end
    for k in np.flatnonzero(side[1:] != side[:-1]).tolist():
        here, there = points[k], points[k + 1]
        share = (end - here[-1]) / (there[-1] - here[-1])
        between = here[:-1] + share * (there - here)[:-1]
        step = np.linalg.norm(there - here)
        if len(known) and np.min(np.linalg.norm(known - between, axis=1)) < step:
            continue
        entering = bool(side[k + 1]) != downward
        first, way = (k + 1, 1) if entering else (k, -1)
        run = points[first::way, -1]
        turns = np.flatnonzero(np.diff(run) * (-1.0 if downward else 1.0) <= 0)
        last = int(turns[0]) if turns.size else len(run) - 1
        yield first, first + way * last
