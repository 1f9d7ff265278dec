"""Whether what was identified can be that of the model's mode, or a column means something else."""

import jax
import numpy as np

from snrmjax.doctor.findings import Finding
from snrmjax.doctor.fitted_hypothesis import checked_states, leading_sensor, usable_rows
from snrmjax.doctor.priors import BAND, FAR_DAMPING, FAR_FREQUENCY, FEWEST_STATES
from snrmjax.doctor.readings import best_reading, misread
from snrmjax.doctor.scale_findings import is_other_scale, scale_findings
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.identify.pointwise.snrm import linear_mode
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact


def caveat(
    data: SteadyStates, model: Structure, points: BackbonePoints | None = None
) -> tuple[Fact, ...]:
    """Columns that seem to mean something else, or a lowest level of another mode.

    The readings of phasors and the modal mass of `check_test`, without its corrections, which take
    long. Where these find nothing: whether natural frequency and damping of the lowest level lie
    far from the model's and farther than they change with amplitude.

    Arguments: `data` and `model` as for identification; `points` that it found, None where it
    found none. Returns no fact or one.
    Validity: that of `check_test`; a force that is known as a voltage only is not looked at.
    """
    # As NumPy's: nothing compiles for the table's own number of states.
    data, points = jax.tree.map(np.asarray, (data, points))
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    if rows.sum() < FEWEST_STATES or np.all(np.isnan(np.asarray(data.force)[rows])):
        return ()
    seen = checked_states(data, model, sensor, rows)
    recorded, best = best_reading(seen, known_mass=True)
    if best is not recorded:
        # Phases that identification itself names need not be named twice.
        return () if wrong_phases(data, model) else (_fact(misread(recorded.judged, best, "")),)
    scale, as_modelled = best.scale, best.as_modelled
    if scale is not None and as_modelled is not None and is_other_scale(scale, as_modelled):
        found = scale_findings(scale, as_modelled, model, data.sensors[sensor])
        errors = [one for one in found if one.severity == "error"]
        if errors:
            return (_fact(errors[0]),)
    return () if points is None else _far(points, model)


def _fact(one: Finding) -> Fact:
    return Fact(
        "column_misread", evidence=one.evidence, advice=one.advice, importable=bool(one.corrections)
    )


def _far(points: BackbonePoints, model: Structure) -> tuple[Fact, ...]:
    """The lowest level far from the linear mode, and farther than the curves reach."""
    good = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    columns = (points.amplitude, points.natural_frequency, points.damping_ratio)
    rows, level = np.column_stack([np.asarray(c) for c in columns]), np.asarray(points.level)
    medians = [np.median(rows[good & (level == k)], axis=0) for k in np.unique(level[good])]
    # Of each level, the smallest amplitude first.
    found = np.array(sorted(map(tuple, medians))).reshape(-1, 3)[:, 1:]
    linear = np.array(linear_mode(model.modes), dtype=float)
    if not len(found) or linear[1] <= 0 or found[:, 1].min() <= 0:
        return ()
    off = np.log(found / linear)
    least = np.maximum([FAR_FREQUENCY, np.log(FAR_DAMPING)], np.ptp(off, axis=0))
    far = np.abs(off[0]) > least
    if not far.any():
        return ()
    names = tuple(np.array(["natural frequency", "damping"])[far].tolist())
    lowest, mode = ((w / (2 * np.pi), ratio) for w, ratio in (found[0].tolist(), linear.tolist()))
    return (Fact("far_from_linear_mode", quantities=names, lowest=lowest, linear=mode),)


def linear_damping_note(fit: JointFit, model: Structure) -> tuple[Fact, ...]:
    """That a joint fit and the linear test differ in damping at zero amplitude.

    By more than both 95 % bands allow. Nothing where the model states no error of its damping.
    """
    modes = model.modes
    j = modes.mode_of_interest
    linear, linear_std = float(linear_mode(modes)[1]), modes.damping_ratio_std.item(j)
    at_rest = fitted_values(fit, displacement=np.zeros(1))
    fitted, std = float(at_rest.damping_ratio[0]), float(at_rest.damping_ratio_std[0])
    both = float(np.hypot(std, linear_std))
    if not linear_std > 0 or not abs(fitted - linear) > BAND * both:  # NaN says nothing
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


def with_caveat(error: ValueError, data: SteadyStates, model: Structure) -> ValueError:
    """The error of an identification, with what the columns seem to mean, if that is why."""
    misread_so = caveat(data, model)
    return ValueError(" ".join((str(error), *map(str, misread_so)))) if misread_so else error
