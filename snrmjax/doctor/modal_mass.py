"""The modal mass that a table asks for over the model's: rms, units, volts, another scale."""

from typing import NamedTuple

import numpy as np

from snrmjax.doctor.balance_fit import BalanceFit, ModeStates
from snrmjax.doctor.findings import Finding, Repair
from snrmjax.doctor.readings import off_by_frequency
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD
from snrmjax.model.structures import Structure

_SIGMAS = 4.0
_LEAST = 0.04  # relative, that is spoken of
_OF_MISFIT = 1.5  # a mode that is missed by a share says its mass no better than that share
STEEPLY = 0.13  # relative, from which on it is no error of a linear test
_MOST_ERROR = 0.04  # relative 1σ of the modal mass, beyond which the states do not say it
_ROOT_TWO = 0.02  # relative distance from √2 that is an rms, at least
_ALIKE = 0.35  # logarithm of a ratio of stiffness, within which potential and states agree


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
    unsure = max(_SIGMAS * std / kappa, _OF_MISFIT * fit.misfit)
    if abs(off) < max(STEEPLY, unsure, 2.5 * error):
        if abs(off) < max(_LEAST, unsure):
            return []
        return [
            Finding(
                *("shape_not_mass_normalised", "info", where),
                f"{size}, {100 * (kappa - 1):.2g} % beside it: within what linear tests leave.",
                f"none needed; dividing the shape by {np.sqrt(kappa):.4g} would make them agree.",
            )
        ]
    # Within 1σ of the linear test's modal mass: √2 is likelier than any other factor there.
    if abs(abs(off) - 0.5 * np.log(2)) < max(_ROOT_TWO, 3 * std / kappa, error):
        which = "responses" if off > 0 else "forces"
        columns = "velocity columns" if off > 0 else "`force_n`"
        return [
            Finding(
                *("rms_for_peak", "error", where),
                f"{size}, √2 = 1.414 {'times too much' if off > 0 else 'too little'}: the {which} "
                "are rms, not peak amplitudes.",
                f"multiply the {columns} by √2 = 1.41421.",
                repairs=(_factor(off > 0, 2**0.5),),
            )
        ]
    quantity = off_by_frequency(kappa, float(np.median(states.frequency)))
    if quantity:
        return [_differentiated(quantity, size, where)]
    volts, shape = _votes(states, fit, model)
    units = mixed_units(states, fit, model)
    if units:
        size = "if the units are right"
    either = [
        Finding(
            *("volts_as_force", "warning" if units else "error", where),
            f"{size}: the force column is no force in newtons but {kappa:.3g} per "
            f"newton, as a drive voltage is{volts.why}.",
            "if it is a voltage, call the column `drive_v` and leave its gain to the "
            "identification; where the response is wrong in its place, that would leave all "
            "amplitudes wrong.",
            repairs=(Repair(force_unit="V", fit_gain=True),),
        ),
        Finding(
            *("shape_not_mass_normalised", "warning" if units else "error", where),
            f"{size}: the shape (or participation) of the model is not mass-normalised{shape.why}.",
            f"if it is the shape, divide `shape` and `participation` of the model by "
            f"{np.sqrt(kappa):.4g} each (or one by {kappa:.4g}), or find the modes anew, scaled "
            "by the sensor at the force.",
            repairs=(Repair(scale_model=True),),
        ),
    ]
    first = [wrong_unit(fit, units, where)] if units else []
    if volts.weight > shape.weight:
        return [*first, *either[:1]]
    if shape.weight > volts.weight:
        return [*first, *either[1:]]
    # The data cannot say which: both are named, each with the other.
    other = "; a {} of another scale would look the same"
    return first + [
        one._replace(evidence=one.evidence.rstrip(".") + other.format(word) + ".")
        for one, word in zip(either, ("mode shape", "force"), strict=True)
    ]


def _differentiated(quantity: str, size: str, where: str) -> Finding:
    """Amplitudes of an acceleration or displacement whose phases are a velocity's already."""
    if quantity == "acceleration":
        return Finding(
            *("acceleration_as_velocity", "error", where),
            f"{size}, 1/Ω of it: the amplitudes are accelerations, the phases those of velocities.",
            "divide the amplitudes by Ω = 2πf, not the phases, in the laboratory's file.",
        )
    return Finding(
        *("displacement_as_velocity", "error", where),
        f"{size}, Ω of it: the amplitudes are displacements, the phases those of velocities.",
        "multiply the amplitudes by Ω = 2πf, not the phases, in the laboratory's file.",
    )


class MixedUnit(NamedTuple):
    """Numbers of one unit that were read as another's, and what the modal mass then becomes."""

    column: str  # "response" or "force"
    unit: str  # of the numbers
    taken_for: str
    mass: float  # over the model's

    @property
    def words(self) -> str:
        """The mistake."""
        return f"the {self.column} in {self.unit}, taken for {self.taken_for}"

    @property
    def repair(self) -> Repair:
        """Reading with the right unit."""
        unit = _WRITTEN.get(self.unit, self.unit)
        if self.column == "force":
            return Repair(force=1 / self.mass, force_unit=unit)
        return Repair(response=self.mass, unit=unit)


# The likely one first: a number of the small unit read as one of the large, then the reverse.
_SIZES = (
    *(("response", "g", "m/s²", 9.80665), ("response", "mm", "m", 1e-3)),
    *(("response", "µm", "m", 1e-6), ("response", "inches", "m", 0.0254)),
    *(("force", "mN", "N", 1e-3), ("force", "kN", "N", 1e3), ("force", "pounds", "N", 4.4482216)),
)
_WRITTEN = {"m/s²": "m/s2", "µm": "um", "inches": "in", "pounds": "lbf"}


def _every_mix_up() -> tuple[MixedUnit, ...]:
    """κ is force over response: upside down for a force, and where both units change places."""
    taken, swapped = [], []
    for column, unit, other, size in _SIZES:
        mass = size if column == "response" else 1 / size
        taken.append(MixedUnit(column, unit, other, mass))
        swapped.append(MixedUnit(column, other, unit, 1 / mass))
    return (*taken, *swapped)


_MIXED_UNITS = _every_mix_up()


def mixed_units(states: ModeStates, fit: BalanceFit, model: Structure) -> tuple[MixedUnit, ...]:
    """The mix-ups of units that explain the modal mass over the model's, the likeliest first.

    Where the model's potential says that the response is right, those of the force alone.
    """
    own = model.modes.own_modal_mass_std
    allowed = float(UNSTATED_MODAL_MASS_STD if own is None else own)
    tolerance = max(_ROOT_TWO, 3 * float(np.hypot(fit.mass_std / fit.mass, allowed)))
    near = [one for one in _MIXED_UNITS if abs(np.log(fit.mass / one.mass)) < tolerance]
    bend = _bend(states, fit, model) if near else None
    right = bend is not None and abs(np.log(bend)) < _ALIKE
    return tuple(one for one in near if not (right and one.column == "response"))


def wrong_unit(fit: BalanceFit, units: tuple[MixedUnit, ...], where: str) -> Finding:
    """That the modal mass is off by the factor between two units, and which these may be."""
    words = ", or ".join(one.words for one in units)
    right = ", or ".join(f"{one.column}s in {one.unit}" for one in units)
    return Finding(
        *("wrong_unit", "error", where),
        f"{mass_in_words(fit)}: the factor {units[0].mass:.4g} of {words}.",
        f"import again, {right}.",
        repairs=tuple(one.repair for one in units),
    )


def _factor(of_response: bool, factor: float) -> Repair:
    return Repair(response=factor) if of_response else Repair(force=factor)


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
        if abs(np.log(ratio)) < _ALIKE:
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
