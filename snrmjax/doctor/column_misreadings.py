"""Caveats of an identification: misread columns, or results far from the model's mode."""

import jax
import numpy as np

from snrmjax.doctor.findings import Finding
from snrmjax.doctor.fitted_hypothesis import checked_states, leading_sensor, usable_rows
from snrmjax.doctor.interpretations import best_interpretation, misread
from snrmjax.doctor.priors import BAND, FAR_DAMPING, FAR_FREQUENCY, FEWEST_STATES
from snrmjax.doctor.scale_findings import is_other_scale, scale_findings
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.identify.pointwise.snrm import linear_mode
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ


def caveat(
    data: SteadyStates, model: Structure, points: BackbonePoints | None = None
) -> tuple[Fact, ...]:
    """Columns that seem to be misread, or a lowest level that seems to be of another mode.

    Checks the interpretations of phasors and the modal mass of `check_test`, without its slower
    corrections; if these are fine, whether natural frequency and damping of the lowest level are
    farther from the model's than they change with amplitude.

    Arguments: `data` and `model` as for identification; `points` identified, None if there are
    none. Returns no fact or one.
    Validity: that of `check_test`; forces known as a voltage only are not checked.
    """
    # NumPy arrays: nothing is compiled for the table's number of states.
    data, points = jax.tree.map(np.asarray, (data, points))
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    if rows.sum() < FEWEST_STATES or np.all(np.isnan(np.asarray(data.force)[rows])):
        return ()
    checked = checked_states(data, model, sensor, rows)
    recorded, best = best_interpretation(checked, known_mass=True)
    if best is not recorded:
        # Wrong phases that identification reports need not be reported twice.
        return () if wrong_phases(data, model) else (_fact(misread(recorded.fit, best, "")),)
    scale, as_modelled = best.scale, best.as_modelled
    if scale is not None and as_modelled is not None and is_other_scale(scale, as_modelled):
        findings = scale_findings(scale, as_modelled, model, data.sensors[sensor])
        errors = [one for one in findings if one.severity == "error"]
        if errors:
            return (_fact(errors[0]),)
    return () if points is None else _far(points, model)


def _fact(one: Finding) -> Fact:
    return Fact(
        "column_misread", evidence=one.evidence, advice=one.advice, importable=bool(one.corrections)
    )


def _far(points: BackbonePoints, model: Structure) -> tuple[Fact, ...]:
    """A lowest level far from the linear mode, beyond the range of the curves."""
    good = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    columns = (points.amplitude, points.natural_frequency, points.damping_ratio)
    rows, level = np.column_stack([np.asarray(c) for c in columns]), np.asarray(points.level)
    medians = [np.median(rows[good & (level == k)], axis=0) for k in np.unique(level[good])]
    # One row for each level, the smallest amplitude first.
    identified = np.array(sorted(map(tuple, medians))).reshape(-1, 3)[:, 1:]
    linear = np.array(linear_mode(model.modes), dtype=float)
    if not len(identified) or linear[1] <= 0 or identified[:, 1].min() <= 0:
        return ()
    off = np.log(identified / linear)
    least = np.maximum([FAR_FREQUENCY, np.log(FAR_DAMPING)], np.ptp(off, axis=0))
    far = np.abs(off[0]) > least
    if not far.any():
        return ()
    names = tuple(np.array(["natural frequency", "damping"])[far].tolist())
    lowest, mode = ((w / HERTZ, ratio) for w, ratio in (identified[0].tolist(), linear.tolist()))
    return (Fact("far_from_linear_mode", quantities=names, lowest=lowest, linear=mode),)


def linear_damping_note(fit: JointFit, model: Structure) -> tuple[Fact, ...]:
    """Note on damping at zero amplitude that differs between a joint fit and the linear test.

    Where the difference exceeds both 95 % bands. Nothing without a stated error of the model's
    damping.
    """
    modes = model.modes
    j = modes.mode_of_interest
    linear, linear_std = float(linear_mode(modes)[1]), modes.damping_ratio_std.item(j)
    at_rest = fitted_values(fit, displacement=np.zeros(1))
    fitted, std = float(at_rest.damping_ratio[0]), float(at_rest.damping_ratio_std[0])
    both = float(np.hypot(std, linear_std))
    if not linear_std > 0 or not abs(fitted - linear) > BAND * both:  # False for NaN
        return ()
    return (
        Fact(
            "damping_at_rest",
            fitted=fitted,
            fitted_std=std,
            linear=linear,
            linear_std=linear_std,
            apart=abs(fitted - linear) / both,
        ),
    )


def with_caveat(error: InputError, data: SteadyStates, model: Structure) -> InputError:
    """The error of an identification, with the misread column as its probable cause."""
    notes = caveat(data, model)
    return InputError(" ".join((str(error), *map(str, notes)))) if notes else error
