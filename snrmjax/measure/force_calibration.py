"""Force from drive voltage: a straight line through the forces of several voltages."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.result import AbstractResult, quantity
from snrmjax.numerics.rules import POSITIVE, require


class ForceCalibration(AbstractResult):
    """The line F = gain · drive + offset, and how well it is known."""

    gain: Float[Array, ""] = quantity("", "N/V", "gain")
    offset: Float[Array, ""] = quantity("", "N", "offset")
    # Of gain and offset; NaN = unknown.
    covariance: Float[Array, "2 2"] = quantity(
        "term other_term", "products of N/V and N", "covariance"
    )
    # NaN with two points.
    residual_std: Float[Array, ""] = quantity("", "N", "scatter about the line")
    # NaN where no error is stated.
    misfit: Float[Array, ""] = quantity("", "1", "scatter about the line over the stated 1σ")

    def force(self, drive: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Force in N at a drive in V."""
        return self.gain * drive + self.offset

    def force_std(self, drive: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """1σ in N of the line at a drive in V, without the scatter about it."""
        row = self._row(drive)
        return jnp.sqrt(jnp.einsum("...i,ij,...j->...", row, self.covariance, row))

    def force_covariance(self, drive: Float[Array, " state"]) -> Float[Array, "state state"]:
        """Covariance in N² of the forces at several drives, which share the line's error."""
        row = self._row(drive)
        return row @ self.covariance @ row.T

    def _row(self, drive: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
        return jnp.stack([jnp.asarray(drive), jnp.ones_like(drive)], axis=-1)


def calibrate_force(
    drive: Shaped[np.ndarray | Array, " level"],
    force: Shaped[np.ndarray | Array, " level"],
    force_std: Shaped[np.ndarray | Array, " level"] | None = None,
    *,
    force_covariance: Shaped[np.ndarray | Array, "level level"] | None = None,
) -> ForceCalibration:
    """Straight line F = gain · V + offset through the forces of several drive voltages.

    Generalised least squares with the stated errors; without any, equal weights and the variance
    from the scatter about the line, Σ(F − gain · V − offset)² / (n − 2).

    Arguments: `drive` in V; `force` in N; `force_std` its 1σ in N, independent, or in its place
    `force_covariance` in N², which may hold errors that all levels share.
    Returns `ForceCalibration`; with two points and no stated errors its covariance is NaN.
    Differentiable by all of them, except for the scatter of points exactly on a line.
    Raises `ValueError` for fewer than two different drives, numbers that are not finite, standard
    deviations that are not positive, or a covariance that is not positive definite.
    Reference: Kwarta & Allen, section 4.1, Figs. 15c and 15d.

    >>> line = calibrate_force([0.01, 0.02, 0.03], [1.9138e-4, 4.6678e-4, 7.3752e-4])
    >>> line.gain.round(6), line.offset.round(8)
    (Array(0.027307, dtype=float64), Array(-8.091e-05, dtype=float64))
    """
    volts, newtons = jnp.asarray(drive, dtype=float), jnp.asarray(force, dtype=float)
    n = volts.size
    given: dict[str, tuple[Array, tuple[int, ...]]] = {
        "`drive`": (volts, (n,)),
        "`force`": (newtons, (n,)),
    }
    if force_std is not None and force_covariance is not None:
        raise ValueError("`force_std` and `force_covariance` are both given; give one.")
    stated = force_std is not None or force_covariance is not None
    std, covariance = jnp.ones(n), jnp.eye(n)
    if force_std is not None:
        std = jnp.asarray(force_std, dtype=float)
        given["`force_std`"] = (std, (n,))
    if force_covariance is not None:
        covariance = jnp.asarray(force_covariance, dtype=float)
        given["`force_covariance`"] = (covariance, (n, n))
    for name, (value, shape) in given.items():
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, but has {value.shape}.")
        require(name, value, *([POSITIVE] if value is std else []))
    root = jnp.diag(std) if force_covariance is None else jnp.linalg.cholesky(covariance)
    if not isinstance(root, jax.core.Tracer) and not np.all(np.isfinite(root)):
        raise ValueError("`force_covariance` must be positive definite, but is not.")
    if n < 2 or (not isinstance(volts, jax.core.Tracer) and np.unique(volts).size < 2):
        raise ValueError(
            f"`drive` must contain two different voltages at least, but is {np.asarray(volts)}."
        )
    return _line(volts, newtons, root, stated)


@eqx.filter_jit
def _line(
    drive: Float[Array, " level"],
    force: Float[Array, " level"],
    root: Float[Array, "level level"],
    stated: bool,
) -> ForceCalibration:
    scale = jnp.array([jnp.max(jnp.abs(drive)), 1.0])
    design = jnp.stack([drive / scale[0], jnp.ones_like(drive)], axis=1)
    whitened = jax.scipy.linalg.solve_triangular(
        root, jnp.column_stack([design, force]), lower=True
    )
    orthogonal, upper = jnp.linalg.qr(whitened[:, :2])
    line = jax.scipy.linalg.solve_triangular(upper, orthogonal.T @ whitened[:, 2])
    inverse = jax.scipy.linalg.solve_triangular(upper, jnp.eye(2)) / scale[:, None]
    freedom = drive.size - 2
    residual = jnp.stack([force - design @ line, whitened[:, 2] - whitened[:, :2] @ line])
    scatter, misfit = (
        jnp.sqrt(jnp.sum(residual**2, axis=1) / freedom) if freedom else jnp.full(2, jnp.nan)
    )
    return ForceCalibration(
        gain=line[0] / scale[0],
        offset=line[1],
        covariance=(inverse @ inverse.T) * (1.0 if stated else scatter**2),
        residual_std=scatter,
        misfit=misfit if stated else jnp.array(jnp.nan),
    )


def apply_calibration(data: SteadyStates, calibration: ForceCalibration) -> SteadyStates:
    """Steady states with `force` and `force_std` filled in from `drive`.

    F = gain · drive + offset with its standard deviation, that of the line alone, where a drive is
    given; a state without one keeps its force. Because all states share the line, their force
    errors are correlated: `ForceCalibration.force_covariance` has the whole of it.

    Arguments: `data`; `calibration`, in N and V. Returns `SteadyStates`; `drive` is kept.
    Differentiable by the drives and the calibration; a drive for which the line gives no positive
    force leaves the derivatives of the other states as they are.
    Raises `ValueError` when no state has a drive, or when the line gives a force that is not
    positive (NaN when traced): such a drive lies below the range that the line can be used in.
    Reference: Kwarta & Allen, section 4.1.

    >>> from snrmjax.measure.states import steady_states
    >>> line = calibrate_force([0.01, 0.02, 0.03], [1.0, 2.0, 3.0])
    >>> data = steady_states([1], [500.0], [np.nan], [0.1 + 0j], drive=[0.05])
    >>> apply_calibration(data, line).force.round(9)
    Array([5.], dtype=float64)
    """
    driven = jnp.isfinite(data.drive)
    # Without NaN inside: it would pass `where` in a gradient.
    drive = jnp.where(driven, data.drive, 0.0)
    force = calibration.force(drive)
    unusable = driven & ~(force > 0)
    if not isinstance(force, jax.core.Tracer) and not isinstance(driven, jax.core.Tracer):
        if not np.any(driven):
            raise ValueError("`data` must have a drive voltage for a state at least, but has none.")
        if np.any(unusable):
            row = int(np.argmax(unusable))
            raise ValueError(
                f"`data` has drive {data.drive[row]:g} V in state {row}, for which the line gives "
                f"{force[row]:g} N; a force must be positive."
            )
    force = jnp.where(unusable, jnp.nan, force)
    std = jnp.where(unusable, jnp.nan, calibration.force_std(drive))
    return dataclasses.replace(
        data,
        force=jnp.where(driven, force, data.force),
        force_std=jnp.where(driven, std, data.force_std),
    )
