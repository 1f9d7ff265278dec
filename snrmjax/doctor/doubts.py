"""Whether what was identified can be that of the model's mode, or a column means something else."""

from typing import NamedTuple

import jax
import numpy as np

from snrmjax.doctor.balance_fit import BalanceFit, ModeStates, as_recorded, fit_balance
from snrmjax.doctor.check import FEWEST
from snrmjax.doctor.modal_mass import STEEPLY, mass_findings
from snrmjax.doctor.mode_checks import misread
from snrmjax.doctor.mode_states import leading_sensor, mode_states, usable_rows
from snrmjax.doctor.readings import agrees, best_reading
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

_QUICK = (("1,2", "1"), ("s5", "s4"))  # families of curves, of which one is enough to be content
_FAR_FREQUENCY, _FAR_DAMPING = 0.05, 3.0  # relative; ratio: beyond any drift of a linear test
_BAND = 1.96  # standard deviations of a 95 % band
_HERTZ = 2 * np.pi


def doubt(
    data: SteadyStates, model: Structure, points: BackbonePoints | None = None
) -> tuple[str, ...]:
    """A sentence where columns seem to mean something else, or the lowest level another mode.

    The readings of phasors and the modal mass of `check_test`, without its corrections, which take
    long. Where these find nothing: whether natural frequency and damping of the lowest level lie
    far from the model's and farther than they change with amplitude.

    Arguments: `data` and `model` as for identification; `points` that it found, None where it
    found none.
    Returns no sentence or one: evidence, size, likely cause, and what mends it.
    Validity: that of `check_test`; a force that is known as a voltage only is not looked at.
    """
    # As NumPy's: nothing compiles for the table's own number of states.
    data, points = jax.tree.map(np.asarray, (data, points))
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    if rows.sum() < FEWEST or np.all(np.isnan(np.asarray(data.force)[rows])):
        return ()
    states = mode_states(data, model, sensor, rows)
    lowest = "" if points is None else _lowest(points, model)
    if not _content(states, model):
        said = _misread(states, model, data.sensors[sensor], lowest)
        if said is not None:
            # Phases that identification itself names need not be named twice.
            return () if said.of_phases and wrong_phases(data, model) else (said.sentence,)
    return () if points is None else _far(points, model, lowest)


class _Said(NamedTuple):
    of_phases: bool
    sentence: str


def _content(states: ModeStates, model: Structure) -> bool:
    """Whether a quick fit shows the phasors of a velocity and the model's modal mass."""
    own = float(model.modes.natural_frequency[model.modes.mode_of_interest])

    def agreeing(fit: BalanceFit) -> bool:
        return agrees(fit, own) and abs(np.log(fit.mass)) < STEEPLY

    pairs = _QUICK if len(states.level) >= 4 * 5 else _QUICK[:1]
    return any(agreeing(fit_balance(states, as_recorded(states), pair)) for pair in pairs)


def _misread(states: ModeStates, model: Structure, sensor: str, lowest: str) -> _Said | None:
    """What the doctor finds of readings and scales, in a sentence; None where that is nothing."""
    modes = model.modes
    recorded, best = best_reading(states, float(modes.natural_frequency[modes.mode_of_interest]))
    of_phases = best.name != recorded.name
    if of_phases:
        errors = [misread(recorded, best, sensor)]
    else:
        told = mass_findings(states, best.fit, model, sensor)
        errors = [one for one in told if one.severity == "error"]
    if not errors:
        return None
    one = errors[0]
    more = "; `snrmjax check` writes the command" + (
        ", and names what else it may be where the units are right."
        if one.kind == "wrong_unit"
        else "."
    )
    mend = f"{one.mend.rstrip('.')}{more if one.repairs else '.'}"
    return _Said(of_phases, f"{one.evidence.rstrip('.')}{lowest}. To mend it: {mend}")


def _lowest(points: BackbonePoints, model: Structure) -> str:
    """What the lowest level has, beside what the model has, as the end of a sentence."""
    found = _of_levels(points)
    if not found:
        return ""
    modes = model.modes
    one = modes.mode_of_interest
    own, ratio = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
    frequency, damping = found[0]
    return (
        f"; the lowest level has {frequency / _HERTZ:.5g} Hz and {100 * damping:.3g} % of critical "
        f"damping, the model {own / _HERTZ:.5g} Hz and {100 * ratio:.3g} %"
    )


def _of_levels(points: BackbonePoints) -> list[tuple[float, float]]:
    """Median natural frequency and damping ratio of each level, the smallest amplitude first."""
    good = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    level, amplitude = np.asarray(points.level), np.asarray(points.amplitude)
    natural, damping = np.asarray(points.natural_frequency), np.asarray(points.damping_ratio)
    found = [
        (float(np.median(amplitude[mine])), np.median(natural[mine]), np.median(damping[mine]))
        for mine in (good & (level == k) for k in np.unique(level[good]))
    ]
    return [(float(frequency), float(ratio)) for _, frequency, ratio in sorted(found)]


def _far(points: BackbonePoints, model: Structure, lowest: str) -> tuple[str, ...]:
    """The lowest level far from the linear mode, and farther than the curves reach."""
    found = np.array(_of_levels(points))
    modes = model.modes
    one = modes.mode_of_interest
    own, ratio = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
    if not len(found) or ratio <= 0 or found[:, 1].min() <= 0:
        return ()
    frequency, damping = np.log(found[:, 0] / own), np.log(found[:, 1] / ratio)
    far = [
        what
        for what, off, least in (
            ("natural frequency", frequency, _FAR_FREQUENCY),
            ("damping", damping, np.log(_FAR_DAMPING)),
        )
        if abs(off[0]) > max(least, np.ptp(off))
    ]
    if not far:
        return ()
    return (
        f"{' and '.join(far)} at small amplitude {'are' if len(far) > 1 else 'is'} not the linear "
        f"mode's{lowest}. Likely a model of another mode or assembly, or a lowest level that is "
        "not small: name the mode by `mode_of_interest`, or find the linear modes of this "
        "assembly by `snrmjax modes`.",
    )


def linear_damping_note(fit: JointFit, model: Structure) -> tuple[str, ...]:
    """A sentence where a joint fit and the linear test differ in damping at zero amplitude.

    By more than both 95 % bands allow. Nothing where the model states no error of its damping.
    """
    modes = model.modes
    one = modes.mode_of_interest
    linear, own = float(modes.damping_ratio[one]), float(modes.damping_ratio_std[one])
    at_rest = fitted_values(fit, displacement=np.zeros(1))
    fitted, std = float(at_rest.damping_ratio[0]), float(at_rest.damping_ratio_std[0])
    both = float(np.hypot(std, own))
    if not own > 0 or not abs(fitted - linear) > _BAND * both:  # NaN says nothing
        return ()
    return (
        f"at zero amplitude the fit has {100 * fitted:.4g} ± {100 * std:.2g} % of critical "
        f"damping, the model's linear test {100 * linear:.4g} ± {100 * own:.2g} % (1σ): "
        f"{abs(fitted - linear) / both:.2g} combined standard deviations apart. Likely the lowest "
        "level is not small (friction and joints damp differently there), the shaker is part of "
        "one test only, or a force or phase is off in one of them; a level below the lowest, or "
        "`snrmjax modes` on the lowest level, tells.",
    )


def with_doubt(error: ValueError, data: SteadyStates, model: Structure) -> ValueError:
    """The error of an identification, with what the columns seem to mean, if that is why."""
    said = [one for one in doubt(data, model) if one not in str(error)]
    return ValueError(" ".join((str(error), *said))) if said else error
