"""The force itself: drop-out at resonance, and harmonics that the structure did not make."""

import numpy as np

from snrmjax.doctor.balance_fit import BalanceFit, ModeStates, basis
from snrmjax.doctor.findings import FORCE_HARMONICS, Finding, Repair, rows_in_words
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

_REMARK = 0.2  # likewise, that is a remark
_DROP = 0.5  # share of a level's force that is missing at resonance
_HELD = 0.25  # spread of the response within a level, below which it may be controlled
_BY_ITSELF = 0.7  # its correlation with the mobility, above which it is not
_SEEN = 0.6  # correlation of force and response, negative
_AMPLITUDES = 3.0  # largest over smallest, over which a damping is the same or not
_MORE_DAMPING = 0.3  # relative, from which on a damping is not the linear test's
_LEAST_HARMONIC = 0.035  # of the force's fundamental
_CERTAIN = 6.0  # 1σ
_GAIN = 30.0  # of the criterion


def dropout_findings(states: ModeStates, where: str) -> list[Finding]:
    """Levels whose force falls where the response is largest, though the response is not held."""
    rows: list[int] = []
    worst, said = 0.0, 0
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        if len(mine) < 5:
            continue
        force, size = states.force[mine], np.abs(states.velocity[mine])
        mobility = size / force
        # A controlled amplitude wanders by chance; a weak shaker's still peaks at resonance.
        peaked = np.ptp(size) > 0 and np.corrcoef(np.log(size), np.log(mobility))[0, 1] > _BY_ITSELF
        if np.ptp(np.log(size)) < _HELD and not peaked:
            continue
        drop, nominal = _fall(force, mobility)
        if drop > _REMARK:
            said += 1
            if drop > worst:
                worst = drop
                rows = [int(states.row[j]) for j in mine[force < nominal * (1 - 0.8 * drop)]]
    if not said:
        return []
    return [
        Finding(
            "force_dropout",
            "warning" if worst > _DROP else "info",
            where,
            f"at resonance the force falls by up to {100 * worst:.3g} % of what it is beside it, "
            f"on {said} of {states.n_levels} levels ({rows_in_words(rows)}): the structure moves "
            "the shaker.",
            "use the measured force of every state (`force_n`), never the nominal one; control the "
            "force, or the response, to keep its amplitude.",
            tuple(rows),
        )
    ]


def _fall(force: np.ndarray, mobility: np.ndarray) -> tuple[float, float]:
    """Share of a level's force that is missing at resonance, and the force beside it in N.

    Zero where the force does not fall as the mobility grows.
    """
    near = mobility > 0.6 * mobility.max()
    far = mobility < 0.8 * mobility.max()
    log_f, log_m = np.log(force), np.log(mobility)
    if not far.any() or np.ptp(log_f) == 0 or np.corrcoef(log_f, log_m)[0, 1] > -_SEEN:
        return 0.0, float(force.max())
    nominal = float(np.quantile(force[far], 0.85))
    return 1 - float(force[near].min()) / nominal, nominal


def deepest_fall(states: ModeStates) -> float:
    """The largest share of a level's force that is missing at resonance, whatever is held."""
    falls = [0.0]
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        if len(mine) >= 5:
            force = states.force[mine]
            falls.append(_fall(force, np.abs(states.velocity[mine]) / force)[0])
    return max(falls)


def shaker_damping(
    states: ModeStates, fit: BalanceFit, model: Structure, where: str
) -> list[Finding]:
    """Damping above the linear test's by one amount at all amplitudes, at its own frequency.

    That is what a shaker adds between its drive and the structure, (Bl)²/R of a coil on a voltage;
    what structures add changes with amplitude. Nothing where the model states no error of its
    damping.
    """
    modes = model.modes
    one = modes.mode_of_interest
    own, ratio = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
    std = float(modes.damping_ratio_std[one])
    used = fit.used
    amplitude = np.abs(states.velocity[used]) / states.frequency[used]
    if not std > 0 or not ratio > 0 or np.ptp(np.log(amplitude)) < np.log(_AMPLITUDES):
        return []
    times = fit.damping[used] / (2 * own * ratio)
    excess = float(times.min()) - 1
    error = float(times.min() * np.hypot(std / ratio, fit.misfit / np.sqrt(used.sum())))
    low = np.flatnonzero(used)[np.argmin(amplitude)]
    away = float(np.sqrt(max(fit.stiffness[low], 0.0))) / own - 1
    if excess < max(_MORE_DAMPING, _CERTAIN * error) or np.ptp(times) > 0.5 * excess:
        return []
    if abs(away) > ratio:
        return []
    return [
        Finding(
            *("volts_as_force", "warning", where),
            f"the damping is {times.min():.3g} ± {error:.1g} times the model's and more at all "
            f"amplitudes, the natural frequency the model's within {100 * abs(away):.2g} %: a "
            "shaker damps so where its drive voltage, or a force on its own side, is taken for the "
            "force on the structure; an assembly that damps more would look the same.",
            "measure the force at the structure; if the column is a voltage, call it `drive_v`; if "
            "it is that force, repeat the linear test on this assembly.",
            repairs=(Repair(force_unit="V", fit_gain=True),),
        )
    ]


def harmonic_findings(
    data: SteadyStates,
    states: ModeStates,
    fit: BalanceFit,
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
        h = np.asarray(data.harmonics)[states.row, sensor, k]
        std = np.asarray(data.harmonic_std)[states.row, sensor]
        good = np.isfinite(h) & (np.abs(h) > 0)
        if good.sum() < 8:
            continue
        ratio, error, gain = _of_force(states, fit, model, h, std, order, good)
        if ratio > _LEAST_HARMONIC and ratio > _CERTAIN * error and gain > _GAIN:
            found.append((ratio, error, order, gain))
    if not found:
        return []
    words = ", ".join(
        f"{100 * ratio:.3g} ± {100 * error:.1g} % of order {order}"
        for ratio, error, order, _ in found
    )
    return [
        Finding(
            FORCE_HARMONICS,
            "warning",
            where,
            f"the force has harmonics, {words} of its fundamental: that part of the response's "
            f"harmonics keeps its phase to the force (criterion smaller by {found[0][3]:.3g}).",
            "control the harmonics of the force, or put their sizes into the model as an effect on "
            "the force's spectrum; do not read the harmonics as the structure's.",
        )
    ]


def _of_force(
    states: ModeStates,
    fit: BalanceFit,
    model: Structure | None,
    h: np.ndarray,
    std: np.ndarray,
    order: int,
    good: np.ndarray,
) -> tuple[float, float, float]:
    """Size of the force's harmonic over its fundamental, its 1σ, and how much it explains."""
    w = order * states.frequency[good]
    if model is None:
        own, rate, constant = (
            float(np.median(fit.stiffness[fit.used])),
            0.0,
            1 / max(fit.mass, 1e-12),
        )
    else:
        modes = model.modes
        one = modes.mode_of_interest
        own = float(modes.natural_frequency[one]) ** 2
        rate = 2 * float(modes.damping_ratio[one]) * own**0.5
        constant = states.constant
    mobility = 1j * w * constant / (own - w**2 + 1j * rate * w)
    size = np.abs(states.velocity[good])
    turn = np.exp(1j * order * np.angle(states.velocity[good]))
    force = states.force[good]
    noise = np.where(np.isfinite(std[good]) & (std[good] > 0), std[good], 1e-3 * size)
    noise = np.hypot(noise, 0.02 * np.abs(h[good]))
    target = h[good] / noise
    made = (mobility * force / noise)[:, None]
    amplitude = size / states.frequency[good]
    best: tuple[float, np.ndarray] | None = None
    plain = np.inf
    n = 2 * len(target)
    for family in (None, f"{order},{order - 1}", "1,1,2", "1,2,4", "s4", "s5"):
        if family is None:
            own_part = np.zeros((len(target), 0), dtype=complex)
        else:
            own_part = basis(family, amplitude).values * (turn / noise * mobility * size)[:, None]
        if 4 * own_part.shape[1] > len(target):
            continue
        for with_force in (False, True):
            design = np.concatenate([made, own_part], axis=1) if with_force else own_part
            theta = np.linalg.lstsq(design, target, rcond=1e-10)[0]
            square = float(np.sum(np.abs(target - design @ theta) ** 2))
            scale = max(1.0, square / max(n / 2 - design.shape[1], 1))
            criterion = square / scale + n * np.log(scale) + 2 * design.shape[1] * np.log(n)
            if with_force and (best is None or criterion < best[0]):
                inverse = np.linalg.pinv(design.conj().T @ design)
                error = float(np.sqrt(scale * abs(inverse[0, 0])))
                best = criterion, np.array([abs(theta[0]), error])
            elif not with_force:
                plain = min(plain, criterion)
    if best is None:
        return 0.0, np.inf, 0.0
    return float(best[1][0]), float(best[1][1]), float(plain - best[0])
