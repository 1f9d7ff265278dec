"""Whether the curve through single states' points and the joint fit of them say the same."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm

from snrmjax.identify.inference.corrected_states import with_level_errors_removed
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.notes import in_words
from snrmjax.identify.pointwise.backbone import BackboneFit, BackboneValues, fit_backbone
from snrmjax.identify.pointwise.backbone_points import BackbonePoints, identify_points
from snrmjax.identify.pointwise.knot_terms import place_knots
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of

_HERTZ = 2 * np.pi  # rad/s
_MOST = 12  # amplitudes that are compared
_FEWEST = 3  # states with a point
_CHANCE = 0.05  # of any difference beyond the limit where both curves and their bands are right
_EXPLAINED = 0.7  # of the largest difference, to which a reason must bring it down
_SILENT = 1e-3  # relative error of a level that changes nothing one could see


class Agreement(eqx.Module):
    """The pointwise curves beside the joint fit's, at amplitudes that the states have.

    Differences are joint less pointwise, in units of both bands' 1σ combined (√(σ₁² + σ₂²)). Both
    rest on the same states, so that agreeing curves differ by less than that. Beyond `limit` is
    what chance would do to none of the amplitudes in 19 of 20 such comparisons (Bonferroni's
    bound) if both bands were right. They differ more often than that where both should agree, in 6
    of 40 exact sets with noise: mostly in damping at the smallest amplitude, where the pointwise
    band is too narrow and the joint fit was right.
    """

    curves: BackboneFit  # through the points, with the model's modal mass and levels as recorded
    pointwise: BackboneValues
    joint: BackboneValues
    frequency_difference: Float[np.ndarray, " amplitude"]
    damping_difference: Float[np.ndarray, " amplitude"]
    limit: float
    reasons: tuple[str, ...] = eqx.field(static=True)  # of a difference beyond the limit

    @property
    def largest(self) -> float:
        """The largest difference of frequency or damping, in combined standard deviations."""
        return _largest(self.frequency_difference, self.damping_difference)

    @property
    def agree(self) -> bool:
        """Whether no difference lies beyond the limit."""
        return self.largest <= self.limit

    def notes(self) -> tuple[str, ...]:
        """What a reader must know where both differ: where, by how much, and why."""
        if self.agree:
            return ()
        parts = []
        for name, difference, ours, theirs, unit, size in (
            (
                "natural frequency",
                self.frequency_difference,
                self.pointwise.natural_frequency,
                self.joint.natural_frequency,
                "Hz",
                1 / _HERTZ,
            ),
            (
                "damping",
                self.damping_difference,
                self.pointwise.damping_ratio,
                self.joint.damping_ratio,
                "% of critical",
                100.0,
            ),
        ):
            if np.max(np.abs(difference)) > self.limit:
                k = int(np.argmax(np.abs(difference)))
                parts.append(
                    f"in {name} by {abs(difference[k]):.2g} combined standard deviations at "
                    f"{float(self.pointwise.velocity[k]):.3g} m/s (pointwise "
                    f"{size * float(ours[k]):.5g}, joint {size * float(theirs[k]):.5g} {unit})"
                )
        return (
            f"the curve through the points and the joint fit differ {' and '.join(parts)}; chance "
            f"explains up to {self.limit:.2g}. Both are shown. Why: "
            f"{'; '.join(self.reasons)}.",
        )


def compare_with_pointwise(
    data: SteadyStates, model: Structure | LinearModes, fit: JointFit
) -> Agreement | None:
    """The curves through the points of single states beside those of a joint fit.

    The former are those of `identify_backbone`: with the model's modal mass, levels as recorded,
    and every state an independent measurement. Where both differ, the same curves with what the
    joint fit found (its modal mass, its levels' gains and phases) tell which of it is the reason.

    Arguments: `data` are the steady states with the errors of the instruments that the fit found
    removed (`corrected_states`).
    Returns None where fewer than three states have a point: there is nothing to compare.
    """
    modes = modes_of(model)
    given = model.level_stds if isinstance(model, Structure) else (0.0, 0.0, 0.0, 0.0)

    points = jax.tree.map(np.asarray, identify_points(data, modes))
    use = _with_a_point(points)
    if use.sum() < _FEWEST:
        return None
    at = place_knots(points.amplitude[use], points.level[use], _MOST)
    curves = fit_backbone(points, modes, level_stds=given)
    joint = fitted_values(fit, displacement=at)
    own = curves.backbone.values(jnp.asarray(at))
    frequency, damping = _differences(own, joint)
    limit = float(norm.isf(_CHANCE / (4 * len(at))))  # two sides, two curves
    reasons: tuple[str, ...] = ()
    if _largest(frequency, damping) > limit:

        def left(data: SteadyStates, modes: LinearModes) -> float:
            points = identify_points(data, modes)
            if _with_a_point(points).sum() < _FEWEST:
                return np.inf
            other = fit_backbone(points, modes, level_stds=given).backbone
            return _largest(*_differences(other.values(jnp.asarray(at)), joint))

        reasons = _reasons(data, modes, fit, _largest(frequency, damping), left)
    return Agreement(curves, own, joint, frequency, damping, limit, reasons)


def _with_a_point(points: BackbonePoints) -> Bool[np.ndarray, " state"]:
    return np.asarray(points.usable) & np.isfinite(np.asarray(points.amplitude))


def _differences(
    pointwise: BackboneValues, joint: BackboneValues
) -> tuple[Float[np.ndarray, " amplitude"], Float[np.ndarray, " amplitude"]]:
    pairs = (
        (pointwise.natural_frequency, pointwise.natural_frequency_std),
        (pointwise.damping_ratio, pointwise.damping_ratio_std),
    )
    others = (
        (joint.natural_frequency, joint.natural_frequency_std),
        (joint.damping_ratio, joint.damping_ratio_std),
    )
    frequency, damping = (
        (np.asarray(theirs) - np.asarray(ours)) / np.hypot(np.asarray(std), np.asarray(other))
        for (ours, std), (theirs, other) in zip(pairs, others, strict=True)
    )
    return frequency, damping


def _largest(*differences: Float[np.ndarray, " amplitude"]) -> float:
    return float(np.max(np.abs(np.concatenate(differences))))


def _reasons(
    data: SteadyStates,
    modes: LinearModes,
    fit: JointFit,
    largest: float,
    left: Callable[[SteadyStates, LinearModes], float],
) -> tuple[str, ...]:
    """Why both differ, as far as can be told; `left` is the largest difference of other points."""
    reasons: list[str] = []
    tried: list[tuple[str, SteadyStates, LinearModes]] = []
    levels = np.asarray(fit.unknowns.level * fit.prior.level)[:, :2]
    corrected = data
    if np.any(np.abs(levels) > _SILENT):
        corrected = with_level_errors_removed(data, fit)
        size = in_words(np.append(np.max(np.abs(levels), axis=0), [0.0, 0.0]))
        tried.append((f"levels are off by up to {size} in the joint fit", corrected, modes))
    found = float(fit.problem.modal_mass_of(fit.unknowns))
    prior = float(fit.prior.linear[-1])
    if prior > 0:
        std = found * prior * float(np.sqrt(fit.covariance[-1, -1]))
        model = 1 / abs(float(fit.problem.modal_constant))
        told = (
            f"the points take the model's modal mass of {model:.4g} kg, the joint fit found "
            f"{found:.4g} ± {std:.2g} kg"
        )
        tried.insert(0, (told, data, fit.modes_found))
    if len(tried) == 2:
        both = " and ".join(one[0] for one in tried)
        tried.append((both, corrected, fit.modes_found))
    for told, states, own in tried:
        rest = left(states, own)
        if rest < _EXPLAINED * largest:
            reasons.append(f"{told} (with that in the points too, at most {rest:.2g} are left)")
            break
    if not reasons:
        pair = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
        reasons.append(
            "neither a modal mass nor errors of levels that the joint fit found explain it; its "
            f"curves ({pair[0].words}; damping: {pair[1].words}) may not bend as the points do, or "
            "states far from resonance, which both weigh differently, contradict those near it"
        )
    correlation = float(np.max(fit.noise.autocorrelation))
    if correlation > 0:
        worth = (1 + correlation) / (1 - correlation)
        reasons.append(
            "the residuals of neighbouring states are correlated: the joint fit counts about "
            f"{worth:.0f} states as one, the band of the points every state for itself, which "
            "makes it too narrow"
        )
    if fit.noise.stated and fit.noise.scale > 1.5:
        reasons.append(
            f"the joint fit misses the data by {fit.noise.scale:.2g} times the stated noise, which "
            "the band of the points takes as it is"
        )
    return tuple(reasons)
