"""One thing at a time that may have gone wrong with a table, corrected: does a mode fit then?

Every correction has few unknowns; the likelihood of the balance with it, less ln(numbers)/2 for
each unknown, is compared with that of the table as it is.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.balance_fit import (
    BalanceFit,
    Corrected,
    ModeStates,
    best_balance,
    fit_balance,
)
from snrmjax.doctor.force_checks import deepest_fall
from snrmjax.identify.checks.residual_autocorrelation import (
    along_resonance,
    independent_share,
    residual_autocorrelation,
)

_LIMITS = (0.79, 0.8, 0.815, 0.83, 0.85, 0.875, 0.9, 0.93, 0.96, 0.985)
"""Limits of a channel over its largest recorded fundamental; that is 4/π of them at most."""
_SHARES = (0.12, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.88)
"""What is left of a transient at the end of a step, at the mode's own damping."""
_FLOORS = (0.02, 0.04, 0.08, 0.16, 0.32)
"""Noise of the force's cell over the smallest force."""
_FALLEN = 0.5  # share of a level's force that is missing at resonance, at least
_REFITTED = 4  # of the best kinds of correction, with families of curves of their own


class Remedy(NamedTuple):
    """A correction and the balance with it."""

    kind: str
    name: str  # what of that kind
    corrected: Corrected
    fit: BalanceFit
    gain: float  # of the criterion over the table as it is, for independent states
    value: float = np.nan  # the correction's own parameter
    levels: tuple[int, ...] = ()  # that differ


def corrections(
    states: ModeStates,
    recorded: Corrected,
    base: BalanceFit,
    groups: tuple[tuple[int, ...], ...] = (),
) -> list[Remedy]:
    """All corrections whose likelihood says something for them, the best first.

    Arguments: `recorded` the phasors as they are read; `base` their balance; `groups` the levels
    of each file, where there are several.
    """
    share = independent_share(
        residual_autocorrelation(base.residuals, along_resonance(states.level, states.frequency))
    )
    found = []
    for kind, name, value, levels, corrected in _candidates(states, recorded, base, groups):
        fit = fit_balance(states, corrected, base.families)
        found.append(Remedy(kind, name, corrected, fit, 0.0, value, levels))
    # Of each kind the best with the families of the base, then with its own.
    best: dict[tuple[str, str], Remedy] = {}
    for one in found:
        key = (one.kind, one.name.partition(":")[0])
        if key not in best or one.fit.criterion < best[key].fit.criterion:
            best[key] = one
    rated = []
    for one in sorted(best.values(), key=lambda one: one.fit.criterion)[:_REFITTED]:
        fit = one.fit
        if base.criterion - fit.criterion > 0:
            fit = best_balance(states, one.corrected, start=base.families)
        gain = share * (base.criterion - fit.criterion)
        rated.append(one._replace(fit=fit, gain=float(gain)))
    return sorted((one for one in rated if one.gain > 0), key=lambda one: -one.gain)


Candidate = tuple[str, str, float, tuple[int, ...], Corrected]


def _candidates(
    states: ModeStates,
    recorded: Corrected,
    base: BalanceFit,
    groups: tuple[tuple[int, ...], ...],
) -> Iterator[Candidate]:
    yield from _clipped(states, recorded)
    yield from _unsettled(states, recorded, base)
    for name in ("frequency_trend", "gain_trend", "force_trend"):
        yield "drift", name, np.nan, (), recorded._replace(extra=(name,))
    yield from _noisy_force(states, recorded)
    yield from _of_levels(states, recorded, groups)


def _clipped(states: ModeStates, recorded: Corrected) -> Iterator[Candidate]:
    """The response cut off at a limit, or the force; states at a hard ceiling left out."""
    size = np.abs(recorded.velocity)
    for limit in _LIMITS:
        true, stretch = unclipped(size, limit * size.max())
        yield (
            "clipped_channel",
            "velocity",
            limit * float(size.max()),
            (),
            recorded._replace(
                velocity=recorded.velocity * (true / size),
                stretch=recorded.stretch * stretch,
                log_jacobian=recorded.log_jacobian + float(np.sum(np.log(stretch))),
                parameters=recorded.parameters + 1,
            ),
        )
    force = recorded.force
    for limit in _LIMITS:
        true, stretch = unclipped(force, limit * force.max())
        yield (
            "clipped_channel",
            "force",
            limit * float(force.max()),
            (),
            recorded._replace(force=true, parameters=recorded.parameters + 1),
        )
    for name, values in (("ceiling", size), ("acceleration_ceiling", size * states.frequency)):
        tolerance = max(1e-6, 3 * float(np.median(states.errors[:, 1])) if states.stated else 1e-3)
        at_top = values >= values.max() * (1 - tolerance)
        n = int(at_top.sum())
        if 3 <= n <= 0.6 * len(values) and len(values) - n >= 8:
            yield (
                "clipped_channel",
                name,
                float(values.max()),
                (),
                recorded._replace(used=~at_top),
            )


def unclipped(
    recorded: Float[np.ndarray, " state"], limit: float
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Amplitudes of sines whose fundamental was recorded behind a limit, and their stretch.

    The fundamental of a sine of amplitude a that is cut off at c is a(2/π)(asin s + s√(1 − s²)),
    s = c/a. The stretch is d ln(true) / d ln(recorded).
    """
    s = np.concatenate([np.linspace(1.0, 0.05, 400), np.geomspace(0.05, 0.004, 60)[1:]])
    first = (2 / np.pi) * (np.arcsin(s) + s * np.sqrt(1 - s**2)) / s  # over the limit
    above = recorded > limit
    most = first[-1] * limit
    inside = np.minimum(recorded, most) / limit
    true = np.where(above, limit / np.interp(inside, first, s), recorded)
    slope = np.gradient(
        -np.log(s), np.log(np.maximum.accumulate(first) + 1e-12 * np.arange(len(s)))
    )
    stretch = np.where(above, np.interp(inside, first, slope), 1.0)
    return true, np.clip(stretch, 1.0, 1e4)


def _unsettled(states: ModeStates, recorded: Corrected, base: BalanceFit) -> Iterator[Candidate]:
    """What is left of the motion of the state before, decaying and turning at the mode's own pace.

    In a frame that turns with the force, V_n = V + (V_{n−1} − V) e^{(−D/2 + i(ω̃ − Ω))T} after a
    dwell T.
    """
    damping = np.abs(base.damping)
    omega = np.sqrt(np.maximum(base.stiffness, 0.25 * states.frequency**2))
    typical = float(np.median(damping)) / 2
    if not typical > 0:
        return
    before = np.full(len(states.level), -1)
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        mine = mine[np.argsort(states.order[mine], kind="stable")]
        before[mine[1:]] = mine[:-1]
    first = before < 0
    for turning in (True, False):
        for share in _SHARES:
            dwell = -np.log(share) / typical
            if turning:
                left = np.exp((-damping / 2 + 1j * (omega - states.frequency)) * dwell)
            else:
                left = np.full(len(before), share + 0j)
            for start in ("from_the_state_before", "from_rest"):
                previous = np.where(first, 0.0, recorded.velocity[before])
                now = np.where(first & (start != "from_rest"), 0.0, left)
                true = (recorded.velocity - now * previous) / (1 - now)
                ratio = np.abs(true * (1 - now) / recorded.velocity)
                yield (
                    "unsettled_steps",
                    f"{'turning' if turning else 'lagging'}:{start}",
                    share,
                    (),
                    recorded._replace(
                        velocity=true,
                        stretch=recorded.stretch / np.maximum(ratio, 1e-3),
                        log_jacobian=recorded.log_jacobian,
                        parameters=recorded.parameters + 1,
                    ),
                )


def _noisy_force(states: ModeStates, recorded: Corrected) -> Iterator[Candidate]:
    """A force that falls at resonance into its cell's noise, which is of one size in newtons."""
    if deepest_fall(states) < _FALLEN:
        return
    for share in _FLOORS:
        floor = share * float(states.force.min())
        parameters = recorded.parameters + 1
        noisy = recorded._replace(floor=floor, parameters=parameters)
        yield "force_dropout", "floor", floor, (), noisy


def _of_levels(
    states: ModeStates, recorded: Corrected, groups: tuple[tuple[int, ...], ...]
) -> Iterator[Candidate]:
    """Levels that differ from the others: in gain alone, or in the structure's own properties."""
    n = states.n_levels
    if n < 2:
        return
    apart = {(k,) for k in range(n)} | {tuple(range(k)) for k in range(1, n)} | set(groups)
    if n > 8:
        apart = {(k,) for k in range(n)} | set(groups)
    for some in sorted(apart):
        if not 0 < len(some) < n:
            continue
        which = "+".join(map(str, some))
        yield (
            "different_structures",
            f"levels:{which}",
            np.nan,
            some,
            recorded._replace(
                extra=tuple(f"{k}:{which}" for k in ("frequency", "damping", "force"))
            ),
        )
        yield (
            "different_structures",
            f"frequencies:{which}",
            np.nan,
            some,
            recorded._replace(extra=(f"frequency:{which}",)),
        )
    gains = tuple(f"force:{k}" for k in range(1, n))
    yield "volts_as_force", "gain_of_level", np.nan, (), recorded._replace(extra=gains)
