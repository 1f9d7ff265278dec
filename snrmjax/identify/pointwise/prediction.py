"""Forced responses predicted from an identified backbone: resonances and response curves."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.identify.curves.family_base import Argument
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.snrm import is_single, nonlinear_mode_velocity, sensed_mode
from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.numerics.blocks import by_blocks, padded
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.numerics.rules import InputError


class Resonance(AbstractResult):
    """A phase resonance under a given force: the nonlinear mode moves in phase with it."""

    force: float = quantity("", "N", "force amplitude")
    amplitude: float  # argument of the backbone, m or m/s
    frequency: float = quantity("", "Hz", "frequency")  # rad/s
    damping_ratio: float = quantity("", "1", "damping ratio")
    # At the backbone's sensor, residual modes included.
    velocity: float = quantity("", "m/s", "velocity amplitude")
    continued: bool = quantity("", "1", "beyond the measured amplitudes")


class PredictedResponse(AbstractResult):
    """One connected response curve in order: up the low-frequency side, down the other.

    `isolated` marks a closed curve (isola) detached from the main one.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("point",)

    force: float  # N
    frequency: Float[np.ndarray, " point"] = quantity("point", "Hz", "frequency")  # rad/s
    velocity: Complex[np.ndarray, " point"]  # m/s at the backbone's sensor
    amplitude: Float[np.ndarray, " point"]  # of the backbone's argument
    stable: Bool[np.ndarray, " point"] = quantity("point", "1", "whether the motion is stable")
    branch: tuple[str, ...]  # "lead" (velocity leads the force) or "lag" for every point
    continued: Bool[np.ndarray, " point"] = quantity("point", "1", "beyond the measured amplitudes")
    isolated: bool
    # On extrapolation of the backbone, and events that were not located.
    notes: tuple[Fact, ...]

    @property
    def note(self) -> str:
        """The notes in words."""
        return " ".join(map(str, self.notes))

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with both parts of the velocity."""
        point, real, imaginary = ("point",), self.velocity.real, self.velocity.imag
        return {
            "point": Variable(point, np.arange(len(real)), "1", "point along the curve"),
            **super().variables(),
            "velocity_re_m_s": Variable(point, real, "m/s", "velocity in phase"),
            "velocity_im_m_s": Variable(point, imaginary, "m/s", "velocity 90° ahead"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The force, whether the curve is isolated, and notes."""
        return {"force_n": self.force, "isolated": int(self.isolated), "note": self.note}


LARGEST_AMPLITUDE_RATIO = 1.5
"""Default end of predictions, as a multiple of the largest measured amplitude."""

_SCAN = 4096  # amplitudes
_BLOCK = 512  # amplitudes in one call of the program: any number of them compile once
_ITERATIONS = 4  # fixed-point iterations of frequency and effective participation
_SMALLEST = 0.02  # of its largest amplitude, where the main curve starts


@on_numbers("Differentiate the curves of the backbone themselves.")
def resonances(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    *,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
) -> list[Resonance]:
    """All phase resonances under a force, from every sign change along the backbone.

    At resonance Ω = ω̃ and the velocity amplitude of the mode is v = |A|F/(2ζ̃ω̃), both functions
    of amplitude; the total adds the residual modes. Damping that falls with amplitude can give
    several solutions.

    Arguments: `force` in N; solutions are sought up to `largest_amplitude_ratio` times the
    largest measured amplitude. Beyond the measured amplitudes the backbone is extrapolated along
    its end slopes, without support by measurements: see `Resonance.continued`. Solutions there
    caused by extrapolated damping that falls towards zero are artefacts and are left out.
    Returns the solutions in order of amplitude; an empty list when there is none.
    Raises `ValueError` for a force or a ratio that is not positive.
    Not differentiable: differentiate `Backbone` itself, or `snrm_velocity`.
    Reference: Kwarta & Allen, Eq. (19).
    """
    _require_force(force)
    scan = _scan(backbone, largest_amplitude_ratio)
    amplitude = scan.amplitude
    load = abs(float(backbone.modal_constant)) * force

    def too_weak(at: _OnBackbone) -> Bool[np.ndarray, " point"]:
        return np.signbit(at.excess(load * at.participation(modes)))

    weak = too_weak(scan)
    tips = []
    for k in np.flatnonzero(weak[:-1] != weak[1:]):
        if not weak[k] and amplitude[k] >= backbone.largest:
            continue  # extrapolated damping falls to zero
        root = np.mean(_change(backbone, too_weak, amplitude[k], amplitude[k + 1]))
        tips.append(_resonance(backbone, modes, force, float(root)))
    return tips


@on_numbers("Differentiate `sj.identify.snrm_velocity`.")
def predict_response(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    *,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
    points_per_side: int = 200,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
) -> list[PredictedResponse]:
    """The whole response to a force: both sides of resonance and the unstable part.

    With the amplitude as parameter the frequency has a closed form: for a displacement X
    Ω² = ω̃² − δ²/2 ± √((|A|F/X)² − δ²ω̃² + δ⁴/4), δ = 2ζ̃ω̃, and likewise for a velocity. A point
    is unstable where, at fixed frequency, a larger amplitude needs less force, or where small
    changes of amplitude have negative damping: both follow from the averaged equations.

    Arguments: `force` in N, frequencies in rad/s; `points_per_side` on either side of every
    resonance; curves end at `largest_amplitude_ratio` times the largest measured amplitude. Beyond
    the measured amplitudes the backbone is extrapolated along its end slopes, without support by
    measurements.
    Returns the connected curves, the main one first, then isolas; the `note` of each states where
    it extrapolates.
    Raises `ValueError` for a force or a ratio that is not positive.
    Not differentiable: its points move with the curve's ends. Differentiate `Backbone` itself.
    Reference: Kwarta & Allen, section 2.2 and Eq. (10).
    """
    _require_force(force)
    at_scan = _scan(backbone, largest_amplitude_ratio)
    scan = at_scan.amplitude
    load = abs(float(backbone.modal_constant)) * force

    def responds(at: _OnBackbone) -> Bool[np.ndarray, " point"]:
        return at.frequencies(load * at.participation(modes))[2] >= 0

    inside = responds(at_scan)
    starts = [scan[0]] if inside[0] else []
    ends: list[float] = []
    for k in np.flatnonzero(np.diff(inside.astype(int))):
        low, high = _change(backbone, responds, scan[k], scan[k + 1])
        if inside[k]:
            ends.append(low)
        else:
            starts.append(high)
    if inside[-1]:
        ends.append(scan[-1])
    curves = []
    for number, (low, high) in enumerate(zip(starts, ends, strict=True)):
        main = number == 0 and bool(inside[0])
        if not main and low >= backbone.largest:
            continue  # it starts where extrapolated damping falls to zero
        curve = _one_curve(
            backbone,
            modes,
            force,
            max(low, _SMALLEST * high) if main else low,
            high,
            points_per_side,
            closed=not main,
        )
        keep = (curve.frequency >= from_frequency) & (curve.frequency <= to_frequency)
        # A range that cuts off the peak leaves two separate pieces.
        runs = np.split(np.arange(len(keep)), np.flatnonzero(np.diff(keep.astype(int))) + 1)
        curves += [_part(curve, run, backbone) for run in runs if run.size and keep[run[0]]]
    return curves


def _require_force(force: float) -> None:
    if not force > 0 or not np.isfinite(force):
        raise InputError(f"`force` must be positive, but is {force!r} N.")


def _scan(backbone: Backbone, ratio: float) -> "_OnBackbone":
    """The backbone at amplitudes from zero to `ratio` times the largest measured one.

    Not beyond zero extrapolated damping: a passive structure has no negative damping.
    """
    if not ratio > 0 or not np.isfinite(ratio):
        raise InputError(f"`largest_amplitude_ratio` must be positive, but is {ratio!r}.")
    n = int(np.ceil(_SCAN * max(ratio / LARGEST_AMPLITUDE_RATIO, 1.0)))
    largest = float(backbone.largest)
    at = _on_backbone(backbone, ratio * largest * np.linspace(0.0, 1.0, n))
    none_left = (at.amplitude > largest) & (at.damping <= 0)
    return at.first(int(np.append(none_left, True).argmax()))


class _OnBackbone(NamedTuple):
    """ω̃², 2ζ̃ω̃ and their slopes at given amplitudes, with derived quantities in NumPy."""

    amplitude: Float[np.ndarray, " point"]
    squared: Float[np.ndarray, " point"]
    damping: Float[np.ndarray, " point"]
    squared_slope: Float[np.ndarray, " point"]
    damping_slope: Float[np.ndarray, " point"]
    argument: Argument

    def first(self, n: int) -> "_OnBackbone":
        """The same at the first amplitudes."""
        columns = {name: getattr(self, name)[:n] for name in self._fields[:-1]}
        return self._replace(**columns)

    def participation(self, modes: LinearModes) -> Float[np.ndarray, " point"] | float:
        """`SensedMode.ratio` at the natural frequency."""
        if is_single(modes):
            return 1.0
        return _participation(modes, np.sqrt(np.maximum(self.squared, 0.0)))

    def excess(self, load: float | np.ndarray) -> Float[np.ndarray, " point"]:
        """v·2ζ̃ω̃ − |A|F: zero at a phase resonance."""
        displacement = self.argument == "displacement"
        with np.errstate(invalid="ignore"):
            velocity = self.amplitude * (np.sqrt(self.squared) if displacement else 1.0)
        return velocity * self.damping - load

    def frequencies(self, load: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ω² below and above resonance, and the margin, negative where there is no Ω."""
        with np.errstate(divide="ignore"):
            ratio = (load / self.amplitude) ** 2
        if self.argument == "displacement":
            middle = self.squared - 0.5 * self.damping**2
            margin = ratio - self.damping**2 * self.squared + 0.25 * self.damping**4
        else:
            middle = self.squared + 0.5 * (ratio - self.damping**2)
            margin = middle**2 - self.squared**2
            # The product of the roots is ω̃⁴ > 0, so both may be negative: no real frequency.
            margin = np.where(middle > 0, margin, -np.abs(margin))
        root = np.sqrt(np.maximum(margin, 0.0))
        with np.errstate(invalid="ignore"):
            return middle - root, middle + root, margin

    def stable(self, frequency: Float[np.ndarray, " point"]) -> Bool[np.ndarray, " point"]:
        """Stability of the averaged equations at (amplitude, Ω), see `predict_response`."""
        stiffness = self.squared - frequency**2
        loss = frequency**2 * self.damping * self.damping_slope
        # d(A²F²)/da at fixed Ω, without a positive factor.
        rise = stiffness**2 + (self.damping * frequency) ** 2
        rise += self.amplitude * (stiffness * self.squared_slope + loss)
        return (rise > 0) & (2 * self.damping + self.amplitude * self.damping_slope > 0)


def _on_backbone(backbone: Backbone, amplitude: Float[np.ndarray, " point"]) -> _OnBackbone:
    value, damping, slope, damping_slope = by_blocks(
        lambda some: _values_and_slopes(backbone, some), _BLOCK, amplitude
    )
    return _OnBackbone(amplitude, value, damping, slope, damping_slope, backbone.argument)


@compiled
def _values_and_slopes(
    backbone: Backbone, amplitude: Float[np.ndarray, " point"]
) -> tuple[Array, Array, Array, Array]:
    """Compiled: a scan of thousands of amplitudes is ten times as fast as on the host."""
    at = jnp.asarray(amplitude)

    def curves(a: Array) -> tuple[Array, Array]:
        return backbone.squared_frequency(a), backbone.modal_damping(a)

    # The curves act pointwise: one JVP along ones gives every slope.
    values, slopes = jax.jvp(curves, (at,), (jnp.ones_like(at),))
    return *values, *slopes


def _change(
    backbone: Backbone, holds: Callable[[_OnBackbone], np.ndarray], low: float, high: float
) -> tuple[float, float]:
    """Bracket of the amplitude at which a condition changes, refined to rounding."""
    for _ in range(5):
        fine = low + (high - low) * np.linspace(0.0, 1.0, _BLOCK)
        true = holds(_on_backbone(backbone, fine))
        k = max(int(np.argmin(true == true[0])), 1)
        low, high = fine[k - 1], fine[k]
    return low, high


def _resonance(backbone: Backbone, modes: LinearModes, force: float, amplitude: float) -> Resonance:
    at, load = jnp.asarray(amplitude), jnp.asarray(force)
    frequency, damping = backbone.natural_frequency(at), backbone.damping_ratio(at)
    velocity = _velocity(backbone, modes, load, frequency, frequency, damping)
    return Resonance(
        force=force,
        amplitude=amplitude,
        frequency=float(frequency),
        damping_ratio=float(damping),
        velocity=float(jnp.abs(velocity)),
        continued=amplitude > float(backbone.largest) * (1 + 1e-9),
    )


@compiled
def _velocity(
    backbone: Backbone,
    modes: LinearModes,
    force: Array,
    frequency: Array,
    natural_frequency: Array,
    damping_ratio: Array,
) -> Complex[Array, "*batch"]:
    r = modes.sensors.index(backbone.sensor)
    own = nonlinear_mode_velocity(
        backbone.modal_constant * force, natural_frequency, damping_ratio, frequency
    )
    if not is_single(modes):
        sensed = sensed_mode(modes, frequency)
        own = own * sensed.ratio / sensed.to_mode(r)
    load = jnp.broadcast_to(force, frequency.shape)
    return own + residual_velocity(modes, frequency, load)[..., r]


def _participation(
    modes: LinearModes, frequency: Float[np.ndarray, " point"]
) -> Float[np.ndarray, " point"]:
    """`SensedMode.ratio` at frequencies in rad/s; that of the linear mode where undefined."""
    known = np.isfinite(frequency) & (frequency > 0)
    linear = modes.natural_frequency.item(modes.mode_of_interest)
    rows = padded(np.where(known, frequency, linear))
    return np.asarray(sensed_mode(modes, rows).ratio)[: len(frequency)]


def _one_curve(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    low: float,
    high: float,
    points_per_side: int,
    *,
    closed: bool,
) -> PredictedResponse:
    load = abs(float(backbone.modal_constant)) * force
    # Points are denser where both sides meet: the frequency has a square-root behaviour there.
    angle = np.linspace(0.0, 1.0, points_per_side)
    fraction = 0.5 * (1 - np.cos(np.pi * angle)) if closed else np.sin(0.5 * np.pi * angle)
    amplitude = low + (high - low) * fraction
    both = _on_backbone(backbone, np.concatenate([amplitude, amplitude[::-1]]))
    side, ratio = np.arange(2 * points_per_side) < points_per_side, both.participation(modes)
    # With damping coupling the effective participation depends on the frequency.
    for _ in range(1 if is_single(modes) else _ITERATIONS):
        below, above, _ = both.frequencies(load * ratio)
        squared = np.where(side, below, above)
        if not is_single(modes):
            ratio = _participation(modes, np.sqrt(np.maximum(squared, 0.0)))
    # Points without a real frequency are dropped at the end: array shapes do not depend on the
    # force, and the functions below are compiled once.
    keep = squared > 0
    frequency = np.sqrt(np.where(keep, squared, 1.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        natural = np.sqrt(both.squared)
        damping = both.damping / (2 * natural)
    arrays = (jnp.asarray(v) for v in (force, frequency, natural, damping))
    velocity = np.asarray(_velocity(backbone, modes, *arrays))
    curve = PredictedResponse(
        force=force,
        frequency=frequency,
        velocity=velocity,
        amplitude=both.amplitude,
        stable=both.stable(frequency),
        branch=tuple(np.where(frequency <= natural, "lead", "lag").tolist()),
        continued=both.amplitude > float(backbone.largest) * (1 + 1e-9),
        isolated=closed,
        notes=(),
    )
    return _part(curve, keep, backbone)


def _part(curve: PredictedResponse, keep: np.ndarray, backbone: Backbone) -> PredictedResponse:
    """Selected points of a curve, with a note on those that extrapolate the backbone."""
    amplitude, continued = curve.amplitude[keep], curve.continued[keep]
    notes: tuple[Fact, ...] = ()
    if continued.any():
        ratio = float(amplitude.max() / float(backbone.largest))
        count = {"n_points": int(continued.sum()), "of": len(continued)}
        notes = (Fact("beyond_measured_amplitudes", **count, ratio=ratio),)
    return dataclasses.replace(
        curve,
        frequency=curve.frequency[keep],
        velocity=curve.velocity[keep],
        amplitude=amplitude,
        stable=curve.stable[keep],
        branch=tuple(np.asarray(curve.branch)[keep].tolist()),
        continued=continued,
        notes=notes,
    )
