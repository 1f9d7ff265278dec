"""The force itself: drop-out at resonance, and harmonics that the structure did not make."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from snrmjax.doctor.findings import FORCE_HARMONICS, Finding
from snrmjax.doctor.fitted_hypothesis import CheckedStates, FittedHypothesis
from snrmjax.doctor.priors import CERTAIN, CLEARLY, FORCE_FALLS, FORCE_HARMONIC, HELD, TOGETHER
from snrmjax.identify.test_model.states import TestStates
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact


def dropout_findings(seen: CheckedStates, where: str) -> list[Finding]:
    """Levels whose force falls where the response is largest, though the response is not held."""
    states, dropped = seen.test, []
    for of_level, drop, nominal in _falls(states):
        force, mobility = states.force[of_level], seen.mobility[of_level]
        size = np.log(force * mobility)
        # A controlled amplitude wanders by chance; a weak shaker's still peaks at resonance.
        peaked = np.ptp(size) > HELD and np.corrcoef(size, np.log(mobility))[0, 1] > TOGETHER
        if peaked and drop > FORCE_FALLS:
            dropped.append((drop, of_level[force < nominal * (1 - 0.8 * drop)]))
    if not dropped:
        return []
    worst, at = max(dropped, key=lambda one: one[0])
    rows = tuple(int(seen.row[j]) for j in at)
    evidence = Fact(
        "force_falls", fall=worst, n_levels=len(dropped), of_levels=states.n_levels, rows=rows
    )
    return [Finding("force_dropout", where, evidence, Fact("advice_force_falls"), rows)]


def _falls(states: TestStates) -> Iterator[tuple[Int[np.ndarray, " state"], float, float]]:
    """Of each level of some states these, and what `fall` says of them."""
    for k in range(states.n_levels):
        of_level, fewest = np.flatnonzero(states.level == k), 5
        if len(of_level) >= fewest:
            force = states.force[of_level]
            yield of_level, *fall(force, np.abs(states.velocity[of_level]) / force)


def fall(force: np.ndarray, mobility: np.ndarray) -> tuple[float, float]:
    """Share of a level's force that is missing at resonance, and the force beside it in N.

    Zero where the force does not fall as the mobility grows.
    """
    near = mobility > 0.6 * mobility.max()
    far = mobility < 0.8 * mobility.max()
    log_f, log_m = np.log(force), np.log(mobility)
    if not far.any() or np.ptp(log_f) == 0 or np.corrcoef(log_f, log_m)[0, 1] > -TOGETHER:
        return 0.0, float(force.max())
    nominal = float(np.quantile(force[far], 0.85))
    return 1 - float(force[near].min()) / nominal, nominal


def deepest_fall(states: TestStates) -> float:
    """The largest share of a level's force that is missing at resonance, whatever is held."""
    return max((drop for _, drop, _ in _falls(states)), default=0.0)


def harmonic_findings(
    data: SteadyStates,
    seen: CheckedStates,
    fit: FittedHypothesis,
    model: Structure | None,
    sensor: int,
    where: str,
) -> list[Finding]:
    """Harmonics of the response whose phase is that of the force rather than of the motion.

    H_k = M(kΩ)(c_k F + d_k(a) e^{ikφ}): what the force makes keeps its phase while that of the
    motion, φ, turns through resonance; d_k is a smooth function of the amplitude.
    """
    found = []
    for k, order in enumerate(data.harmonic_order):
        if order < 2:
            continue
        h = np.asarray(data.harmonics)[seen.row, sensor, k]
        std = np.asarray(data.harmonic_std)[seen.row, sensor]
        good = np.isfinite(h) & (np.abs(h) > 0)
        if good.sum() < 8:
            continue
        ratio, error, gain = _of_force(seen, fit, model, h, std, order, good)
        if ratio > max(FORCE_HARMONIC, CERTAIN * error) and gain > CLEARLY:
            found.append((order, ratio, error))
    if not found:
        return []
    evidence = Fact("response_harmonics_of_force", harmonics=tuple(found))
    return [Finding(FORCE_HARMONICS, where, evidence, Fact("advice_harmonics"))]


def _of_force(
    seen: CheckedStates,
    fit: FittedHypothesis,
    model: Structure | None,
    h: np.ndarray,
    std: np.ndarray,
    order: int,
    good: np.ndarray,
) -> tuple[float, float, float]:
    """Size of the force's harmonic over its fundamental, its 1σ, and how much it explains."""
    states = seen.test
    w = order * states.frequency[good]
    if model is None:
        natural_square, rate, constant = float(np.median(fit.stiffness)), 0.0, 1.0
    else:
        modes = model.modes
        one = modes.mode_of_interest
        natural_square = modes.natural_frequency.item(one) ** 2
        rate = 2 * modes.damping_ratio.item(one) * natural_square**0.5
        constant = float(np.median(states.constant))
    mobility = 1j * w * constant / (natural_square - w**2 + 1j * rate * w)
    size = np.abs(seen.recorded[good])
    turn = np.exp(1j * order * np.angle(seen.recorded[good]))
    force = states.force[good]
    noise = np.where(np.isfinite(std[good]) & (std[good] > 0), std[good], 1e-3 * size)
    noise = np.hypot(noise, 0.02 * np.abs(h[good]))
    target = h[good] / noise
    made = (mobility * force / noise)[:, None]
    amplitude = size / states.frequency[good]
    amplitude = amplitude / amplitude.max()
    best, plain = (np.inf, 0.0, np.inf), np.inf  # criterion, size and 1σ; criterion without
    n = 2 * len(target)
    for powers in ((), (0, order - 1), (0, 1, 2), (0, 2, 4), (0, 1, 2, 3), (0, 1, 2, 3, 4)):
        curves = amplitude[:, None] ** np.array(powers, dtype=float)
        own_part = curves * (turn / noise * mobility * size)[:, None]
        if 4 * own_part.shape[1] > len(target):
            continue
        for with_force in (False, True):
            design = np.concatenate([made, own_part], axis=1) if with_force else own_part
            theta = np.linalg.lstsq(design, target, rcond=1e-10)[0]
            square = float(np.sum(np.abs(target - design @ theta) ** 2))
            scale = max(1.0, square / max(n / 2 - design.shape[1], 1))
            criterion = square / scale + n * np.log(scale) + 2 * design.shape[1] * np.log(n)
            if not with_force:
                plain = min(plain, criterion)
            elif criterion < best[0]:
                inverse = np.linalg.pinv(design.conj().T @ design)
                error = float(np.sqrt(scale * abs(inverse[0, 0])))
                best = criterion, float(abs(theta[0])), error
    criterion, ratio, error = best
    return ratio, error, 0.5 * float(plain - criterion) if np.isfinite(criterion) else 0.0
