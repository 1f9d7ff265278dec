"""Whether what was identified can be that of the model's mode, or a column means something else."""

import jax
import numpy as np

from snrmjax.doctor.findings import Finding
from snrmjax.doctor.judgement import checked_states, leading_sensor, usable_rows
from snrmjax.doctor.priors import BAND, FAR_DAMPING, FAR_FREQUENCY, FEWEST_STATES
from snrmjax.doctor.readings import best_reading, misread
from snrmjax.doctor.scale_findings import is_other_scale, scale_findings
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure


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
    if rows.sum() < FEWEST_STATES or np.all(np.isnan(np.asarray(data.force)[rows])):
        return ()
    seen = checked_states(data, model, sensor, rows)
    recorded, best = best_reading(seen, known_mass=True)
    if best is not recorded:
        # Phases that identification itself names need not be named twice.
        if wrong_phases(data, model):
            return ()
        return (_sentence(misread(recorded.judged, best, "")),)
    scale, as_modelled = best.scale, best.as_modelled
    if scale is not None and as_modelled is not None and is_other_scale(scale, as_modelled):
        found = scale_findings(scale, as_modelled, model, data.sensors[sensor])
        errors = [one for one in found if one.severity == "error"]
        if errors:
            return (_sentence(errors[0]),)
    return () if points is None else _far(points, model)


def _sentence(one: Finding) -> str:
    """A finding's fact and what mends it."""
    more = "; `snrmjax check` writes the import." if one.repairs else "."
    return f"{one.evidence} To mend it: {one.mend.rstrip('.')}{more}"


def _far(points: BackbonePoints, model: Structure) -> tuple[str, ...]:
    """The lowest level far from the linear mode, and farther than the curves reach."""
    good = np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))
    columns = (points.amplitude, points.natural_frequency, points.damping_ratio)
    rows, level = np.column_stack([np.asarray(c) for c in columns]), np.asarray(points.level)
    medians = [np.median(rows[good & (level == k)], axis=0) for k in np.unique(level[good])]
    # Of each level, the smallest amplitude first.
    found = np.array(sorted(map(tuple, medians))).reshape(-1, 3)[:, 1:]
    modes = model.modes
    one = modes.mode_of_interest
    own, ratio = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
    if not len(found) or ratio <= 0 or found[:, 1].min() <= 0:
        return ()
    frequency, damping = np.log(found[:, 0] / own), np.log(found[:, 1] / ratio)
    far = [
        what
        for what, off, least in (
            ("natural frequency", frequency, FAR_FREQUENCY),
            ("damping", damping, np.log(FAR_DAMPING)),
        )
        if abs(off[0]) > max(least, np.ptp(off))
    ]
    if not far:
        return ()
    lowest, linear = found[0], (own, ratio)
    said = [f"{w / (2 * np.pi):.5g} Hz and {100 * d:.3g} %" for w, d in (lowest, linear)]
    return (
        f"{' and '.join(far)} at small amplitude {'are' if len(far) > 1 else 'is'} not the linear "
        f"mode's: the lowest level has {said[0]}, the model {said[1]}. Name the mode by "
        "`mode_of_interest`, or find the linear modes of this assembly by `snrmjax modes`.",
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
    if not own > 0 or not abs(fitted - linear) > BAND * both:  # NaN says nothing
        return ()
    return (
        f"at zero amplitude the fit has {100 * fitted:.4g} ± {100 * std:.2g} % of critical "
        f"damping, the model's linear test {100 * linear:.4g} ± {100 * own:.2g} % (1σ): "
        f"{abs(fitted - linear) / both:.2g} combined standard deviations apart. Measure a level "
        "below the lowest, or find the modes of the lowest level by `snrmjax modes`.",
    )


def with_doubt(error: ValueError, data: SteadyStates, model: Structure) -> ValueError:
    """The error of an identification, with what the columns seem to mean, if that is why."""
    said = [one for one in doubt(data, model) if one not in str(error)]
    return ValueError(" ".join((str(error), *said))) if said else error
