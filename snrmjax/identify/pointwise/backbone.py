"""The identified backbone: natural frequency and damping of a mode as curves with bands."""

from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.pointwise.backbone_points import (
    AmplitudeArgument,
    BackbonePoints,
    own_errors,
)
from snrmjax.identify.pointwise.curve_fit import (
    AbstractPointwiseCurve,
    CurveFit,
    LeftOut,
    PointSample,
    between_knots_on_host,
    fit_curve,
    linearised_on_host,
    log_slope,
    predict_left_out,
)
from snrmjax.identify.pointwise.inversion_result import reasons_in_words, spans
from snrmjax.identify.pointwise.knot_terms import place_knots
from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import ErrorSizes
from snrmjax.numerics.result import AbstractResult, Variable

CurveFamily = Literal["spline", "piecewise_linear"]
MOST_KNOTS = 60
_SAMPLES = 200  # as many as files have: one compiled function serves both
_HERTZ = 2 * np.pi
# 1σ of d ln(what the motion adds to ω̃² and to 2ζ̃ω̃) / d ln Ω at equal amplitude, of which the
# method knows nothing. Damping: −1 for dry friction, 1 for v|v|, 2 for v³; stiffness: 0 where
# harmonics are small, 0.75 on the curved beam, whose static and second harmonic soften it.
OFF_RESONANCE = (0.5, 1.0)
SMOOTHING = tuple(float(w) for w in 10.0 ** np.arange(-12, 3))


class Anchor(NamedTuple):
    """How far curves had to be bent to meet the linear mode at zero amplitude."""

    frequency_gap: float  # rad/s, free curve at zero minus linear frequency
    frequency_gap_std: float  # rad/s
    damping_gap: float  # free damping ratio at zero minus the linear one
    damping_gap_std: float
    largest_frequency_shift: float  # rad/s, anchored minus free curve among the measured points
    largest_damping_shift: float


class BackboneValues(AbstractResult):
    """A backbone at some amplitudes, with 1σ."""

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    velocity: Float[Array, " point"]  # m/s
    natural_frequency: Float[Array, " point"]  # rad/s
    natural_frequency_std: Float[Array, " point"]
    damping_ratio: Float[Array, " point"]
    damping_ratio_std: Float[Array, " point"]
    modal_damping: Float[Array, " point"]  # 2ζ̃ω̃, 1/s
    modal_damping_std: Float[Array, " point"]

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        return (
            f"BackboneValues: {np.size(self.velocity)} amplitudes, {spans(self.velocity)} m/s",
            f"natural frequency {spans(np.asarray(self.natural_frequency) / _HERTZ)} Hz",
            f"damping ratio {spans(100 * np.asarray(self.damping_ratio))} %",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; the columns of `backbone.csv`."""

        def column(values: Array | np.ndarray, unit: str, meaning: str) -> Variable:
            return Variable(("velocity_m_s",), np.asarray(values).reshape(-1), unit, meaning)

        natural, natural_std = self.natural_frequency, self.natural_frequency_std
        return {
            "velocity_m_s": column(self.velocity, "m/s", "velocity amplitude"),
            "natural_frequency_hz": column(np.asarray(natural) / _HERTZ, "Hz", "natural frequency"),
            "natural_frequency_std_hz": column(np.asarray(natural_std) / _HERTZ, "Hz", "its 1σ"),
            "damping_ratio": column(self.damping_ratio, "1", "damping ratio"),
            "damping_ratio_std": column(self.damping_ratio_std, "1", "its 1σ"),
            "modal_damping_1_s": column(self.modal_damping, "1/s", "modal damping 2ζω"),
            "modal_damping_std_1_s": column(self.modal_damping_std, "1/s", "its 1σ"),
        }


class Backbone(AbstractResult):
    """ω̃ and ζ̃ of one mode as functions of the amplitude of its motion at one sensor.

    All its functions are differentiable by the amplitude and the values at the knots; straight
    lines have two slopes at a knot, of which derivatives give the mean.

    `squared_frequency` is ω̃² (rad²/s²) and `modal_damping` 2ζ̃ω̃ (1/s), against the
    displacement (m) or the velocity (m/s) amplitude, as `argument` says. Their covariances
    belong to the values at the knots.
    """

    squared_frequency: AbstractPointwiseCurve
    modal_damping: AbstractPointwiseCurve
    squared_frequency_covariance: Float[Array, "knot knot"]
    modal_damping_covariance: Float[Array, "damping_knot damping_knot"]
    modal_constant: Float[Array, ""]  # Φ_r Φᵀb, 1/kg: acceleration per newton at resonance
    smallest: Float[Array, ""]  # amplitude of the smallest point used
    largest: Float[Array, ""]  # amplitude of the largest point used
    argument: AmplitudeArgument = eqx.field(static=True)
    sensor: str = eqx.field(static=True)
    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        ends = self._sampled()
        return (
            f"Backbone at {self.sensor!r} against {self.argument}: "
            f"{self.squared_frequency.knots.shape[0]} and {self.modal_damping.knots.shape[0]} "
            "knots of natural frequency and damping",
            *ends.summary()[1:],
            f"velocity {spans(ends.velocity)} m/s",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; between the smallest and the largest measured amplitude."""
        return self._sampled().variables()

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {"sensor": self.sensor, "amplitude": self.argument}

    def _sampled(self) -> BackboneValues:
        ends = float(self.smallest), float(self.largest)
        return self.values(jnp.asarray(np.linspace(*ends, _SAMPLES)))

    @compiled
    def natural_frequency(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """ω̃ in rad/s."""
        squared = self.squared_frequency(amplitude)
        return jnp.sqrt(jnp.where(squared > 0, squared, jnp.nan))

    @compiled
    def damping_ratio(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """ζ̃ as a fraction of critical."""
        return self.modal_damping(amplitude) / (2 * self.natural_frequency(amplitude))

    @compiled
    def velocity(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Velocity amplitude in m/s on the backbone, where Ω = ω̃."""
        if self.argument == "velocity":
            return jnp.asarray(amplitude)
        return jnp.asarray(amplitude) * self.natural_frequency(amplitude)

    def values(self, amplitude: Float[Array, " point"]) -> BackboneValues:
        """All that the backbone says at some amplitudes, with standard deviations (1σ).

        The two curves' errors are taken as independent, and include how far another curve
        through the same knots is off between them. Differentiable; numbers that nothing is
        differentiated by are evaluated by the host, where nothing compiles.
        """
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((self, amplitude))):
            return self._values(amplitude)
        return self._values_on_host(np.asarray(amplitude, dtype=float))

    def _values_on_host(self, amplitude: Float[np.ndarray, " point"]) -> BackboneValues:
        squared, by_squared = linearised_on_host(self.squared_frequency, amplitude)
        modal, by_modal = linearised_on_host(self.modal_damping, amplitude)
        variance, modal_variance = (
            np.einsum("pk,kl,pl->p", slopes, np.asarray(covariance), slopes)
            for slopes, covariance in (
                (by_squared, self.squared_frequency_covariance),
                (by_modal, self.modal_damping_covariance),
            )
        )
        open_squared, open_modal = (
            between_knots_on_host(curve, amplitude)
            for curve in (self.squared_frequency, self.modal_damping)
        )
        omega = np.sqrt(np.where(squared > 0, squared, np.nan))
        omega_std = np.hypot(np.sqrt(np.maximum(variance, 0.0)), open_squared) / (2 * omega)
        modal_std = np.hypot(np.sqrt(np.maximum(modal_variance, 0.0)), open_modal)
        zeta = modal / (2 * omega)
        zeta_std = np.hypot(modal_std / (2 * omega), zeta * omega_std / omega)
        speed = amplitude if self.argument == "velocity" else amplitude * omega
        found = (speed, omega, omega_std, zeta, zeta_std, modal, modal_std)
        return BackboneValues(*jax.device_put(found))

    @compiled
    def _values(self, amplitude: Float[Array, " point"]) -> BackboneValues:
        squared = CurveFit(self.squared_frequency, self.squared_frequency_covariance)
        damping = CurveFit(self.modal_damping, self.modal_damping_covariance)
        omega = self.natural_frequency(amplitude)
        modal = self.modal_damping(amplitude)
        open_squared, open_modal = (
            one.curve.between_knots(amplitude) for one in (squared, damping)
        )
        omega_std = jnp.hypot(squared.std(amplitude), open_squared) / (2 * omega)
        modal_std = jnp.hypot(damping.std(amplitude), open_modal)
        zeta = modal / (2 * omega)
        return BackboneValues(
            velocity=self.velocity(amplitude),
            natural_frequency=omega,
            natural_frequency_std=omega_std,
            damping_ratio=zeta,
            damping_ratio_std=jnp.hypot(modal_std / (2 * omega), zeta * omega_std / omega),
            modal_damping=modal,
            modal_damping_std=modal_std,
        )


class BackboneFit(AbstractResult):
    """A backbone with what its fit found out."""

    coordinates: ClassVar[tuple[str, ...]] = ("velocity_m_s",)

    backbone: Backbone
    noise_scale: tuple[float, float]  # of ω̃² and of 2ζ̃ω̃; relative noise where none is stated
    level_frequency_std: float  # rad/s, 1σ that the points of one level share
    level_damping_std: float  # the same of the damping ratio
    noise_stated: bool
    anchor: Anchor | None

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        first, *others = self.backbone.summary()
        unit = 1 if self.noise_stated else 100
        scatter = " and ".join(f"{unit * size:.3g}" for size in self.noise_scale)
        kind = "times the stated noise" if self.noise_stated else "% of the measured phasor (1σ)"
        return (
            first.replace("Backbone", "BackboneFit", 1),
            *others,
            f"scatter of natural frequency and damping: {scatter} {kind}",
            f"level to level: {self.level_frequency_std / _HERTZ:.2g} Hz and "
            f"{100 * self.level_damping_std:.2g} % of critical damping (1σ)",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; those of the backbone."""
        return self.backbone.variables()

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            **self.backbone.attributes(),
            "noise_stated": int(self.noise_stated),
            "level_frequency_std_hz": self.level_frequency_std / _HERTZ,
            "level_damping_ratio_std": self.level_damping_std,
        }


def fit_backbone(
    points: BackbonePoints,
    modes: LinearModes,
    *,
    family: CurveFamily = "spline",
    n_knots: int | None = None,
    anchor: bool = False,
    level_stds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> BackboneFit:
    """Fit smooth or piecewise linear curves of ω̃² and 2ζ̃ω̃ to identified points.

    `family` "spline" is a shape-preserving cubic (PCHIP) in the squared amplitude, and
    "piecewise_linear" has straight lines in the amplitude, as the paper has.

    Points are weighted by the stated noise carried through the inversion, the error of their
    amplitude included; where no noise is stated, all have the same relative error of amplitude
    and phase, whose size the scatter gives. What the points of a level share enters the bands:
    what is stated of it, and what the levels scatter beyond that, which is estimated.

    Arguments: `n_knots` of each curve, by default up to 60, with a roughness penalty chosen
    by how well left-out levels are predicted; `anchor` pins both curves at the linear mode at
    zero amplitude and reports how far this moves them; `level_stds` are the 1σ that the states of
    a level share, as `Structure.level_stds` has them: relative gain, phase (rad), natural frequency
    (rad/s) and damping ratio. A stated error of the modal mass, which all points share, widens
    the bands: that of the damping by the same share, that of the frequency off resonance only.
    They also hold that stiffness and damping which come with the motion may change with the
    frequency of the force at equal amplitude, and, where noise is stated, grow where the points
    are farther off the curves than it explains.
    Returns `BackboneFit`. Raises `ValueError` when fewer than two points are usable.
    Validity: the mode must be the only nonlinear one and ω̃, ζ̃ functions of amplitude alone.
    Not differentiable: knots and smoothing are chosen on the host.
    """
    points = jax.tree.map(np.asarray, points)
    use = np.asarray(points.usable & np.isfinite(points.amplitude))
    if use.sum() < 2:
        raise ValueError(
            f"a backbone needs at least 2 solved points, but only {int(use.sum())} of "
            f"{use.size} are: {reasons_in_words(points.status)}."
        )
    if family not in ("spline", "piecewise_linear"):
        raise ValueError(f'`family` must be "spline" or "piecewise_linear", not {family!r}.')
    stated = bool(np.all(np.isfinite(points.relative_std[use])))
    kept = jax.tree.map(lambda values: values[use], points)
    mass_std = modes.own_modal_mass_std
    shared = (level_stds, 0.0 if mass_std is None else float(mass_std))
    j, r = modes.mode_of_interest, reference_sensor(modes)
    omega, zeta = float(modes.natural_frequency[j]), float(modes.damping_ratio[j])
    linear = (omega**2, 2 * zeta * omega)
    settings = (stated, shared, family, n_knots, linear)
    free = _fit_pair(kept, *settings, None)
    pair, report = free, None
    if anchor:
        pair = _fit_pair(kept, *settings, linear)
        report = _anchor_report(
            (free[0][0], free[1][0]),
            (pair[0][0], pair[1][0]),
            np.asarray(points.amplitude)[use],
            omega,
            zeta,
        )
    (squared, squared_sizes), (damping, damping_sizes) = pair
    amplitude = np.asarray(points.amplitude)[use]
    backbone = Backbone(
        squared_frequency=squared.curve,
        modal_damping=damping.curve,
        squared_frequency_covariance=squared.covariance,
        modal_damping_covariance=damping.covariance,
        modal_constant=modes.mode_shape[r, j] * modes.participation[j],
        smallest=jax.device_put(amplitude.min()),
        largest=jax.device_put(amplitude.max()),
        argument=points.argument,
        sensor=points.sensor,
    )
    middle = float(np.median(np.asarray(points.natural_frequency)[use]))
    return BackboneFit(
        backbone=backbone,
        noise_scale=(squared_sizes.noise_scale, damping_sizes.noise_scale),
        level_frequency_std=squared_sizes.level_std / (2 * middle),
        level_damping_std=damping_sizes.level_std / (2 * middle),
        noise_stated=stated,
        anchor=report,
    )


def _fit_pair(
    points: BackbonePoints,
    stated: bool,
    shared_stds: tuple[tuple[float, float, float, float], float],
    family: CurveFamily,
    n_knots: int | None,
    linear: tuple[float, float],
    anchor: tuple[float, float] | None,
) -> tuple[tuple[CurveFit, ErrorSizes], tuple[CurveFit, ErrorSizes]]:
    amplitude, level = np.asarray(points.amplitude), np.asarray(points.level)
    frequency = np.asarray(points.frequency)
    natural, damping = np.asarray(points.natural_frequency), np.asarray(points.modal_damping)
    values = (natural**2, damping)
    (gain, phase, *own_stds), mass = shared_stds
    # In proportion to the force over the modal mass: the same relative error of all points.
    by_mass = (values[0] - frequency**2, damping)
    away = np.log(frequency / natural)

    def fit(component: int) -> tuple[CurveFit, ErrorSizes]:
        fixed = None if anchor is None else anchor[component]
        knots = place_knots(amplitude, level, n_knots or min(MOST_KNOTS, len(amplitude) // 2))
        if fixed is not None:
            knots = np.concatenate([[0.0], knots])
        slope = np.zeros(len(amplitude))
        # The error of the amplitude matters along the slope, which a first fit tells. It is as
        # smooth as the second: weights by the slopes of a rough curve follow the noise.
        for _ in range(2):
            moved, std = own_errors(points, component, slope, stated=stated)
            std = np.maximum(std, 1e-12 * np.max(np.abs(values[component])))
            own = 2 * natural * own_stds[component]
            shared = np.column_stack([gain * moved[:, 1], phase * moved[:, 2], own])
            nonlinear = values[component] - linear[component]
            off_resonance = OFF_RESONANCE[component] * nonlinear * away
            common = np.column_stack([mass * by_mass[component], off_resonance])
            sample = PointSample(amplitude, values[component], std, level, shared, common)
            weights = SMOOTHING if n_knots is None else SMOOTHING[:1]
            smoothing, sizes = _best_smoothing(family, knots, weights, sample, fixed)
            used = sizes._replace(noise_scale=1.0) if stated else sizes
            given = (family, knots, smoothing, sample)
            best = fit_curve(*given, fixed_first=fixed, sizes=used, own_misfit=stated)
            slope = log_slope(best.curve, amplitude)
        return best, sizes

    return fit(0), fit(1)


def _best_smoothing(
    family: CurveFamily,
    knots: np.ndarray,
    weights: tuple[float, ...],
    points: PointSample,
    fixed: float | None,
) -> tuple[float, ErrorSizes]:
    """The weight of the roughness penalty that predicts left-out levels best, and their errors.

    Of weights whose predictions are as good, the smallest: bands know the spread of a curve, not
    the bias that smoothing gives it. As good is a score within its own standard error, √(2/levels)
    of it, that also differs from the best, level by level, by no more than that difference's.
    """
    if len(np.unique(points.level)) < 3:
        # One or two levels: leave out every third point in turn instead.
        every_third = np.argsort(np.argsort(points.amplitude)) % 3
        points = points._replace(level=every_third, shared=None)
    tried = [predict_left_out(family, knots, weight, points, fixed) for weight in weights]
    best = min(tried, key=lambda one: one.score)
    # Levels that no curve predicts must not decide here either.
    fair = np.argsort(best.squares)[: -(-3 * len(best.squares) // 4)]

    def as_good(one: LeftOut) -> bool:
        worse = (one.squares - best.squares)[fair]
        n = worse.size
        if n < 2:
            return one is best
        near = one.score <= best.score * (1 + np.sqrt(2 / n))
        return near and np.mean(worse) <= np.std(worse, ddof=1) / np.sqrt(n)

    # The best one is as good as itself.
    chosen = next(k for k, one in enumerate(tried) if as_good(one))
    return weights[chosen], tried[chosen].sizes


def _anchor_report(
    free: tuple[CurveFit, CurveFit],
    pinned: tuple[CurveFit, CurveFit],
    amplitude: np.ndarray,
    omega: float,
    zeta: float,
) -> Anchor:
    zero, at = jnp.zeros(1), jnp.asarray(amplitude)
    squared_at_zero = float(free[0].curve(zero)[0])
    damping_at_zero = float(free[1].curve(zero)[0])

    def ratios(pair: tuple[CurveFit, CurveFit]) -> tuple[np.ndarray, np.ndarray]:
        frequency = np.sqrt(np.asarray(pair[0].curve(at)))
        return frequency, np.asarray(pair[1].curve(at)) / (2 * frequency)

    (f_free, z_free), (f_pinned, z_pinned) = ratios(free), ratios(pinned)

    def largest(difference: np.ndarray) -> float:
        return float(difference[np.argmax(np.abs(difference))])

    frequency = np.sqrt(max(squared_at_zero, 0.0))
    return Anchor(
        frequency_gap=frequency - omega,
        frequency_gap_std=float(free[0].std(zero)[0]) / (2 * omega),
        damping_gap=damping_at_zero / (2 * omega) - zeta,
        damping_gap_std=float(free[1].std(zero)[0]) / (2 * omega),
        largest_frequency_shift=largest(f_pinned - f_free),
        largest_damping_shift=largest(z_pinned - z_free),
    )
