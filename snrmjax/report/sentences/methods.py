"""What the other methods have to tell."""

from snrmjax.report.sentences import Wording

SENTENCES: dict[str, Wording] = {
    "sections_between_levels": (
        "no level holds its displacement within ±{spread:%.0f}: sections of equal displacement "
        "are interpolated between levels"
    ),
    "normal_form_fitted": (
        "normal form of degree {degree}, fitted to the trajectory (noise of a sample "
        "{noise_std:.2g} m/s)"
    ),
    "off_the_manifold": "the record is {misfit:%.2g} (rms) off a two-dimensional manifold",
    "decay_read_by": "read by {reading}",
    "bias_of_filter": (
        "bias of the filter, estimated: up to {frequency:%.2g} of the frequency and {damping:%.2g} "
        "of the damping"
    ),
    "ring_down_read": "ring-down {number} from {start_s:.6g} s, read down to {least:.3g} {unit}",
    "power_in_one_shape": "one shape holds {share:%.4g} of the power",
}
