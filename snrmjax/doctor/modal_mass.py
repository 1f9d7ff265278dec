"""The modal mass that a table asks for over the model's: rms, volts, a shape of another scale."""

from typing import NamedTuple

import numpy as np

from snrmjax.doctor.balance_fit import BalanceFit, ModeStates
from snrmjax.doctor.findings import Finding
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD
from snrmjax.model.structures import Structure

_SIGMAS = 4.0
_LEAST = 0.04  # relative, that is spoken of
STEEPLY = 0.13  # relative, from which on it is no error of a linear test
_MOST_ERROR = 0.04  # relative 1σ of the modal mass, beyond which the states do not say it
_BY_FREQUENCY = 0.15  # relative distance from Ω or 1/Ω
_ROOT_TWO = 0.02  # relative distance from √2, that is an rms
_LOW, _HIGH = 0.5, 2.0


def mass_findings(
    states: ModeStates, fit: BalanceFit, model: Structure, where: str
) -> list[Finding]:
    """Nothing where force, response and shape agree within the model's error.

    κ, the modal mass of the data over the model's, is V_recorded/F_recorded upside down against
    the truth: an rms force makes it 1/√2, an rms response √2. Other factors are a force in volts
    or a shape of another scale; what else disagrees says which, if anything does.
    """
    kappa, std = fit.mass, fit.mass_std
    if not kappa > 0 or not np.isfinite(kappa) or std > _MOST_ERROR * kappa:
        return []
    off = float(np.log(kappa))
    own = model.modes.own_modal_mass_std
    allowed = float(UNSTATED_MODAL_MASS_STD if own is None else own)
    error = float(np.hypot(std / kappa, allowed))
    size = mass_in_words(fit)
    if abs(off) < max(STEEPLY, _SIGMAS * std / kappa, 2.5 * error):
        if abs(off) < max(_LEAST, _SIGMAS * std / kappa):
            return []
        return [
            Finding(
                *("shape_not_mass_normalised", "info", where),
                f"{size}, {100 * (kappa - 1):.2g} % beside it: within what linear tests leave.",
                f"none needed; dividing the shape by {np.sqrt(kappa):.4g} would make them agree.",
            )
        ]
    if abs(abs(off) - 0.5 * np.log(2)) < max(_ROOT_TWO, 3 * std / kappa):
        which = "responses" if off > 0 else "forces"
        columns = "velocity columns" if off > 0 else "`force_n`"
        return [
            Finding(
                *("rms_for_peak", "error", where),
                f"{size}, √2 = 1.414 {'times too much' if off > 0 else 'too little'}: the {which} "
                "are rms, not peak amplitudes.",
                f"multiply the {columns} by √2 = 1.41421.",
            )
        ]
    by_frequency = _differentiated(off, float(np.log(np.median(states.frequency))), size, where)
    if by_frequency is not None:
        return [by_frequency]
    volts, shape = _votes(states, fit, model)
    unit = mixed_unit(fit, model)
    first, mend = "", ""
    if unit is not None:
        first = f"that is {unit.factor:.4g}, as with {unit.what}; otherwise "
        mend = f"look at the units first and import again with {unit.option}; "
    either = [
        Finding(
            *("volts_as_force", "error", where),
            f"{size}: {first}the force column is no force in newtons but {kappa:.3g} per "
            f"newton, as a drive voltage is{volts.why}.",
            f"{mend}if it is a voltage: divide `force_n` by {kappa:.4g}, or call it "
            "`drive_v` and identify with `--free force_gain,instrument_phase`; where the response "
            "is wrong in its place, that would leave all amplitudes wrong.",
        ),
        Finding(
            *("shape_not_mass_normalised", "error", where),
            f"{size}: the shape (or participation) of the model is not mass-normalised{shape.why}.",
            f"{mend}if it is the shape: divide `shape` and `participation` by "
            f"{np.sqrt(kappa):.4g} each (or one by {kappa:.4g}); `snrmjax modes` scales shapes by "
            "the drive point.",
        ),
    ]
    if volts.weight > shape.weight:
        return either[:1]
    if shape.weight > volts.weight:
        return either[1:]
    # The data cannot say which: both are named, each with the other.
    other = "; a {} of another scale would look the same"
    return [
        one._replace(evidence=one.evidence.rstrip(".") + other.format(word) + ".")
        for one, word in zip(either, ("mode shape", "force"), strict=True)
    ]


def _differentiated(off: float, log_omega: float, size: str, where: str) -> Finding | None:
    """Amplitudes of an acceleration or displacement whose phases are a velocity's already."""
    if abs(log_omega) < 10 * _BY_FREQUENCY:
        return None
    if abs(off + log_omega) < _BY_FREQUENCY:
        return Finding(
            *("acceleration_as_velocity", "error", where),
            f"{size}, 1/Ω of it: the amplitudes are accelerations, the phases those of velocities.",
            "divide the amplitudes by Ω: import again with `--response CHANNEL:acceleration:m/s^2` "
            "(or `:g`).",
        )
    if abs(off - log_omega) < _BY_FREQUENCY:
        return Finding(
            *("displacement_as_velocity", "error", where),
            f"{size}, Ω of it: the amplitudes are displacements, the phases those of velocities.",
            "multiply the amplitudes by Ω: import again with `--response CHANNEL:displacement:m` "
            "(or `:mm`).",
        )
    return None


class MixedUnit(NamedTuple):
    """A unit that was taken for another one, as the factor between them says."""

    factor: float
    what: str
    option: str


# κ is force over response: what it becomes where a number of one unit is read as another's.
_MIXED_UNITS = (
    MixedUnit(9.80665, "the response in g, taken for m/s²", "`--unit g`"),
    MixedUnit(
        *(1e-3, "the response in mm, taken for m, or the force in kN"),
        "`--unit mm/s` (or its like), or `--force-unit kN`",
    ),
    MixedUnit(1e-6, "the response in µm, taken for m", "`--unit um/s` (or its like)"),
    MixedUnit(1e3, "the force in mN, taken for N", "`--force-unit mN`"),
    MixedUnit(1 / 4.4482216, "the force in pounds, taken for N", "`--force-unit lbf`"),
    MixedUnit(1 / 39.370079, "the response in inches, taken for m", "`--unit in/s` (or its like)"),
)


def mixed_unit(fit: BalanceFit, model: Structure) -> MixedUnit | None:
    """The mix-up of units whose factor is the modal mass over the model's, if there is one."""
    own = model.modes.own_modal_mass_std
    allowed = float(UNSTATED_MODAL_MASS_STD if own is None else own)
    tolerance = max(_ROOT_TWO, 3 * float(np.hypot(fit.mass_std / fit.mass, allowed)))
    near = [one for one in _MIXED_UNITS if abs(np.log(fit.mass / one.factor)) < tolerance]
    return near[0] if near else None


def mass_in_words(fit: BalanceFit) -> str:
    """The modal mass that the states ask for."""
    return f"the states ask for {fit.mass:.4g} ± {fit.mass_std:.2g} times the model's modal mass"


class _Vote:
    """What speaks for one explanation."""

    def __init__(self) -> None:
        self.weight = 0.0
        self.reasons: list[str] = []

    def add(self, weight: float, reason: str) -> None:
        self.weight += weight
        self.reasons.append(reason)

    @property
    def why(self) -> str:
        return f" ({'; '.join(self.reasons)})" if self.reasons else ""


def _votes(states: ModeStates, fit: BalanceFit, model: Structure) -> tuple[_Vote, _Vote]:
    volts, shape = _Vote(), _Vote()
    modes = model.modes
    one = modes.mode_of_interest
    column = np.abs(np.asarray(modes.mode_shape)[:, one])
    if abs(column.max() - 1) < 1e-6 or abs(np.linalg.norm(column) - 1) < 1e-6:
        shape.add(2.0, "its largest entry or its norm is exactly one")
    bend = _bend(states, fit, model)
    if bend is not None:
        ratio = bend
        if abs(np.log(ratio)) < 0.35:
            volts.add(2.0, f"the model's potential, which knows the shape, agrees to {ratio:.2f}")
        else:
            shape.add(2.0, f"the stiffness grows {ratio:.3g} times as the model's potential says")
    used = np.flatnonzero(fit.used)
    low = used[np.argsort(np.abs(states.velocity[used]))[: max(3, len(used) // 8)]]
    own, ratio_of = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
    damping = float(np.median(fit.damping[low])) / (2 * own * ratio_of) if ratio_of > 0 else 1.0
    away = float(np.sqrt(abs(np.median(fit.stiffness[low])))) / own - 1
    if abs(away) > max(2 * ratio_of, 0.01) and damping > 1.3:
        volts.add(
            1.0,
            f"at low amplitude frequency and damping are {100 * away:.2g} % and {damping:.2g} "
            "times off the model's, as where a shaker's armature is part of the structure",
        )
    return volts, shape


def _bend(states: ModeStates, fit: BalanceFit, model: Structure) -> float | None:
    """The measured growth of stiffness over that of the model's potential; None if both are small.

    K(a) − ω² = (2/π) ∫ f(a cos β) cos β dβ / a of the potential's own force, a = |V|/(Ω Φ).
    """
    modes = model.modes
    one = modes.mode_of_interest
    terms = [
        (len(m), float(c))
        for m, c in zip(model.potential.monomials, model.potential.coefficient, strict=True)
        if set(m) == {one}
    ]
    if not terms:
        return None
    sensor = int(np.argmax(np.abs(np.asarray(modes.mode_shape)[:, one])))
    shape = abs(float(modes.mode_shape[sensor, one]))
    used = np.flatnonzero(fit.used)
    q = np.abs(states.velocity[used]) / states.frequency[used] / shape
    beta = 2 * np.pi * (np.arange(64) + 0.5) / 64
    x = q[:, None] * np.cos(beta)
    force = sum(degree * c * x ** (degree - 1) for degree, c in terms)
    own = float(modes.natural_frequency[one]) ** 2
    predicted = 2 * np.mean(force * np.cos(beta), axis=1) / q / own
    measured = fit.stiffness[used] / own - 1
    spread = np.ptp(measured)
    if spread < 0.01 or np.ptp(predicted) < 1e-6:
        return None
    slope = np.polyfit(predicted, measured, 1)[0]
    return float(slope) if slope > 0 else None
