"""Effects that measured states may not distinguish, and what separates them."""

from snrmjax.diagnose.kinds.hypothesis import Confounder

SEPARATED_BY_MEAN_OR_SECOND_HARMONIC = Confounder(
    "record harmonic 2 or the mean displacement at the largest level"
)
ONE_SIDED_OR_TWO_SIDED = Confounder(
    "record harmonic 2 at the largest level: only a one-sided contact generates it"
)
SEPARATED_BY_THIRD_HARMONIC = Confounder(
    "record harmonic 3 at the largest level, whose sign and amplitude differ, and widen the range "
    "of levels"
)
STRUCTURE_OR_FORCE_SPECTRUM = Confounder(
    "record harmonic 2 against level and the force's own spectrum"
)
RESPONSE_SCALE = Confounder(
    "calibrate force and velocity statically, or repeat a level with a known added mass"
)
FORCE_OR_SENSOR_GAIN = Confounder(RESPONSE_SCALE.separated_by, by_calibration=True)
STIFFNESS_OR_MASS = Confounder("add a known mass, or measure a second mode", by_calibration=True)
FRICTION_OR_FORCE_OFFSET = Confounder(
    "measure at the smallest level 30° and more off resonance, on both sides"
)
DRIFT = Confounder("repeat the first level last", by_itself=True)
FAR_MODE_OR_PHASE_ERROR = Confounder(
    "measure 60° and more off resonance on both sides, or with a second sensor"
)
FURTHER_MODE = Confounder(
    "measure with a second sensor, where a further mode has another shape, or sweep wider",
    by_itself=True,
)
WHICH_RESONANCE = Confounder(
    "step through the frequency of the disturbance and record the second and third harmonics of "
    "the velocity (with their noise floor)"
)

CONFOUNDERS = (
    *(SEPARATED_BY_MEAN_OR_SECOND_HARMONIC, ONE_SIDED_OR_TWO_SIDED, SEPARATED_BY_THIRD_HARMONIC),
    *(STRUCTURE_OR_FORCE_SPECTRUM, RESPONSE_SCALE, FORCE_OR_SENSOR_GAIN, STIFFNESS_OR_MASS),
    *(FRICTION_OR_FORCE_OFFSET, DRIFT, FAR_MODE_OR_PHASE_ERROR, FURTHER_MODE, WHICH_RESONANCE),
)
"""In the order in which their measurements are proposed: recordings first, further tests last."""
