"""Nonlinear normal modes: periodic motions of the conservative structure."""

import dataclasses
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.model.effect_shape import conservative_effects
from snrmjax.model.structures import (
    Structure,
    displacement_scale,
    linear_terms_of,
    simulated_structure,
)
from snrmjax.numerics.blocks import by_blocks, on_one_core
from snrmjax.numerics.compiled import as_numpy, compiled, on_numbers
from snrmjax.numerics.result import quantity
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import with_sines
from snrmjax.simulate.continuation.continuation import (
    Curve,
    CurveRange,
    StepControl,
    on_host,
    trace_curve,
)
from snrmjax.simulate.continuation.response_curve import MotionCurve, motions_of
from snrmjax.simulate.continuation.stability import Stability, floquet_multipliers, stability_of

DEFAULT_STEPS = StepControl(first=1e-3, largest=0.02, angle=0.06)
_TONGUE_FRACTION = 0.05  # energy fraction of a harmonic of another mode at internal resonance


class Tongue(NamedTuple):
    """A section of a normal mode in internal resonance: a harmonic drives another mode."""

    mode: int  # the other mode, counted from zero
    harmonic: int
    from_frequency: float  # rad/s, lowest on the section
    to_frequency: float  # rad/s, highest
    energy_fraction: float  # largest fraction of kinetic energy in that harmonic of that mode
    first: int  # index of its first point on the branch; with "skip", of the first one after it
    last: int  # index of its last point; with "skip", of the last one before it

    @property
    def name(self) -> str:
        """The resonance as text, modes counted from one: "1:3 with mode 2"."""
        return f"1:{self.harmonic} with mode {self.mode + 1}"


class NormalModeBranch(MotionCurve):
    """A nonlinear normal mode as a curve of periodic motions from small amplitude.

    Its motions start from rest: the coefficients are the mean and the cosines.
    """

    energy: Float[np.ndarray, " point"] = quantity("point", "J", "energy of the motion")
    mode_fraction: Float[np.ndarray, "point mode"] = quantity(
        "point mode", "1", "fraction of the mean kinetic energy"
    )
    tongues: tuple[Tongue, ...] = ()
    # Without the two trivial ones (shifts in time and energy); None: not requested.
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None

    @property
    def stability(self) -> Int[np.ndarray, " point"]:
        """A `Stability` of every point."""
        if self.multipliers is None:
            return np.full(len(self.frequency), int(Stability.NOT_COMPUTED))
        if not self.multipliers.shape[1]:
            return np.full(len(self.frequency), int(Stability.STABLE))
        return stability_of(self.multipliers)

    def shape(self, sensor: int = 0) -> Float[np.ndarray, "point sensor"]:
        """Velocity fundamentals (m/s) at the sensors, with that of `sensor` positive."""
        # Motions that start from rest have only sine terms in the velocity.
        speed = self.velocity[:, 1].imag
        return speed * np.where(speed[:, sensor] < 0, -1.0, 1.0)[:, None]

    @property
    def resonance(self) -> tuple[str, ...]:
        """The name of the tongue of every point; empty on the backbone."""
        return tuple(
            next((t.name for t in self.tongues if t.first <= k <= t.last), "")
            for k in range(len(self.frequency))
        )


@on_numbers("Differentiate `sj.simulate.normal_mode_at_velocities`.")
@on_one_core
def nonlinear_normal_mode(
    model: Structure,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    largest_amplitude: float | None = None,
    n_samples: int | None = None,
    tongues: Literal["follow", "skip"] = "follow",
    stability: bool = True,
) -> NormalModeBranch:
    """Trace the nonlinear normal mode that starts at the linear mode of interest.

    Solves m q̈ + k q + ∂V/∂q = 0 (damping, friction, and forces that depend on velocity, left out)
    for motions q = Σ a_h cos hΩt, that is, all motions that start from rest; the curve is traced
    by pseudo-arclength continuation through folds and internal-resonance tongues.

    Arguments: `to_frequency` in rad/s, on either side of the linear frequency: the curve ends
    where it crosses it. `largest_amplitude` (kg^1/2 m; by default 30 times the displacement at
    which the mode's own nonlinearity matters) ends a curve that never does. A curve that first
    moves away from `to_frequency` is traced as long as it stays above a tenth and below ten
    times the linear frequency.
    Where a harmonic of the mode resonates with another mode, the curve follows a tongue out and
    back: more than a twentieth of the energy is then in that harmonic of that mode. Tongues are
    reported; with `tongues="skip"` their points are left out, so that only the sections of the
    backbone remain. With `stability` Floquet multipliers determine orbital stability; the two
    trivial ones, for shifts in time and in energy, are left out.
    Returns a `NormalModeBranch` whose `status` is how it ended.
    Raises `ValueError` for a frequency that is not positive or the linear one.
    Not differentiable: differentiate `snrmjax.simulate.normal_mode_at_velocities`.
    Reference: Kerschen et al., Mech. Syst. Signal Process. 23 (2009) 170,
    doi:10.1016/j.ymssp.2008.04.002.
    """
    j = model.modes.mode_of_interest
    omega = model.modes.natural_frequency.item(j)
    if not to_frequency > 0 or to_frequency == omega:
        raise InputError(
            "`to_frequency` must be positive and differ from the linear frequency "
            f"{omega:g} rad/s, but is {to_frequency:g} rad/s."
        )
    model = conservative(simulated_structure(model))
    scale = float(displacement_scale(model)[j])
    balance = harmonic_balance(
        model, 0.0, scale, harmonic_order=harmonic_order, n_samples=n_samples, cosine_only=True
    )
    upward = to_frequency > omega
    lower, upper = (omega / 10, to_frequency) if upward else (to_frequency, omega * 10)
    limit = 30.0 if largest_amplitude is None else largest_amplitude / scale
    ends = np.array([lower, upper, limit])
    curve = on_host(_trace(balance, np.array(j), ends, steps))
    cosines, frequency = balance.motions(curve.points)
    at_rest = np.sum(cosines, axis=1)  # q(0), where the velocity vanishes
    (energy,) = by_blocks(lambda rows: (_energy(model, rows),), 128, at_rest)
    fraction = _kinetic_fractions(balance, cosines)
    multipliers = None
    if stability:
        every = floquet_multipliers(model, with_sines(cosines), frequency)
        trivial = np.argsort(np.abs(every - 1), axis=1)
        multipliers = np.take_along_axis(every, trivial[:, 2:], axis=1)
    branch = NormalModeBranch(
        **motions_of(balance, curve.points),
        status=curve.status,
        energy=energy,
        mode_fraction=fraction.sum(axis=1),
        tongues=_tongues(model, frequency, fraction),
        multipliers=multipliers,
    )
    return _without_tongues(branch) if tongues == "skip" else branch


def conservative(model: Structure) -> Structure:
    """The structure without damping, friction and forces that depend on velocity."""

    def with_ratio(ratio: Array) -> Structure:
        modes = dataclasses.replace(model.modes, damping_ratio=ratio, damping_coupling=None)
        return dataclasses.replace(model, modes=modes, effects=effects)

    effects = conservative_effects(model.effects)
    ones = as_numpy(np.ones(model.n_modes))
    # Damping ratios that cancel the damping of linear changes, which is linear in them.
    none, whole = (as_numpy(linear_terms_of(with_ratio(k * ones)).damping) for k in (0.0, 1.0))
    changes = none != whole  # not for a mode of zero frequency, whose damping is not a ratio
    return with_ratio(jnp.asarray(none / np.where(changes, none - whole, 1.0)))


def free_oscillations(
    model: Structure,
    mode: int,
    within: tuple[float, float],
    harmonic_order: int,
    steps: StepControl = DEFAULT_STEPS,
) -> tuple[Float[np.ndarray, "point coefficient mode"], Float[np.ndarray, " point"]]:
    """Motions of the normal mode that starts at a linear `mode`: coefficients and frequencies.

    Arguments: `model` as simulated; the curve ends where it leaves the frequencies `within`
    (rad/s), which contain the linear one. Returns kg^1/2 m and rad/s.
    """
    model = conservative(model)
    scale = float(displacement_scale(model)[mode])
    balance = harmonic_balance(model, 0.0, scale, harmonic_order=harmonic_order, cosine_only=True)
    curve = on_host(_trace(balance, np.array(mode), np.array([*within, 30.0]), steps))
    cosines, frequency = balance.motions(curve.points)
    return np.asarray(with_sines(cosines)), frequency


@compiled
def _trace(balance: HarmonicBalance, j: Int[Array, ""], ends: Array, steps: StepControl) -> Curve:
    modes, n = balance.model.modes, balance.model.n_modes
    # Start at a small amplitude, where Newton's method at fixed amplitude is well posed.
    size = balance.size + 1
    linear = jnp.zeros(size).at[-1].set(modes.natural_frequency[j] / balance.frequency_scale)
    direction = jnp.zeros(size).at[n + j].set(1.0)
    lower, upper = ends[:2] / balance.frequency_scale
    return trace_curve(
        balance.linearised,
        linear + 1e-3 * direction,
        direction,
        CurveRange(lower, upper, largest_amplitude=ends[2]),
        steps,
        start_across=direction,
    )


def _kinetic_fractions(
    balance: HarmonicBalance, coefficients: Float[np.ndarray, "point coefficient mode"]
) -> Float[np.ndarray, "point coefficient mode"]:
    """Fraction of every harmonic of every mode in the mean kinetic energy."""
    order = np.arange(coefficients.shape[1])[:, None]
    mass = np.asarray(linear_terms_of(balance.model).mass)
    energy = mass * (order * coefficients) ** 2  # twice the mean, over Ω²
    return energy / np.maximum(energy.sum(axis=(1, 2), keepdims=True), np.finfo(float).tiny)


def _tongues(
    model: Structure,
    frequency: np.ndarray,
    energy_fraction: Float[np.ndarray, "point coefficient mode"],
) -> tuple[Tongue, ...]:
    """Sections with more than `_TONGUE_FRACTION` of the energy in a harmonic of another mode."""
    j, fraction = model.modes.mode_of_interest, energy_fraction.copy()
    # Own harmonics are the waveform of the mode, fundamentals of other modes its shape.
    fraction[:, :, j] = 0.0
    fraction[:, :2] = 0.0
    strongest = fraction.max(axis=(1, 2))
    inside = np.concatenate([[False], strongest > _TONGUE_FRACTION, [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    tongues = []
    for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        section = fraction[first:stop].max(axis=0)
        harmonic, mode = np.unravel_index(np.argmax(section), section.shape)
        tongues.append(
            Tongue(
                mode=int(mode),
                harmonic=int(harmonic),
                from_frequency=float(frequency[first:stop].min()),
                to_frequency=float(frequency[first:stop].max()),
                energy_fraction=float(section.max()),
                first=first,
                last=stop - 1,
            )
        )
    return tuple(tongues)


def _without_tongues(branch: NormalModeBranch) -> NormalModeBranch:
    """The branch without the points of its tongues, whose indices then mark the gaps."""
    keep = np.ones(len(branch.frequency), dtype=bool)
    for tongue in branch.tongues:
        keep[tongue.first : tongue.last + 1] = False
    count = np.cumsum(keep)  # points kept up to and including each
    return dataclasses.replace(
        branch,
        frequency=branch.frequency[keep],
        coefficients=branch.coefficients[keep],
        velocity=branch.velocity[keep],
        energy=branch.energy[keep],
        mode_fraction=branch.mode_fraction[keep],
        multipliers=None if branch.multipliers is None else branch.multipliers[keep],
        tongues=tuple(
            tongue._replace(first=int(count[tongue.first]), last=int(count[tongue.first]) - 1)
            for tongue in branch.tongues
        ),
    )


@compiled
def _energy(model: Structure, displacement: Array) -> Array:
    return model.potential_energy(displacement)
