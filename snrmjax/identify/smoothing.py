"""Curves in the linear problem of a selection: their columns, and how smooth they are."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.identify.families import PowerLaw, values_and_slopes
from snrmjax.identify.family_base import AbstractFamily
from snrmjax.identify.roughness import likeness
from snrmjax.identify.splines import SmoothingSpline, bent


class CurveColumns(NamedTuple):
    """A curve where its priors have it, and its derivatives by what may move it."""

    values: Float[np.ndarray, " point"]
    slopes: Float[np.ndarray, "point unknown"]
    prior_std: Float[np.ndarray, " unknown"]  # infinite where there is no prior


def curve_columns(curve: AbstractFamily, at: Float[np.ndarray, " point"]) -> CurveColumns:
    """Of a smoothing spline the unknowns are a straight line and bends, else the parameters.

    A power law is straightened where it is, and drawn for the mean of what its exponent may be.
    """
    values, slopes = values_and_slopes(curve, at)
    if isinstance(curve, PowerLaw):
        middle = values - slopes[:, 2] * float(curve.parameters[2])
        return CurveColumns(middle, slopes, np.array([np.inf, np.inf, curve.odds_std]))
    if not isinstance(curve, SmoothingSpline):
        return CurveColumns(values, slopes, np.full(slopes.shape[1], np.inf))
    parts = bent(curve)
    return CurveColumns(slopes @ parts.straight, slopes @ parts.both, parts.prior_std)


def places_of_bends(
    curve: SmoothingSpline,
    displacement: Float[np.ndarray, " point"],
    speed: Float[np.ndarray, " point"],
) -> Float[np.ndarray, " bend"]:
    """Displacements where a curve may bend; those of one of velocity by the states near them."""
    at = float(curve.scale) * np.sqrt(np.asarray(curve.knots)[1:-1])
    if curve.argument == "velocity":
        order = np.argsort(speed)
        return np.interp(at, speed[order], displacement[order])
    return at


def with_sizes(curve: SmoothingSpline, size: Float[np.ndarray, " bend"]) -> SmoothingSpline:
    """A curve with bends of these sizes, alike from one to the next, and not yet otherwise.

    Its bends are then combinations of them that are independent, each in its own 1σ.
    """
    root = np.linalg.cholesky(likeness(len(size))) * size[:, None]
    bends = np.linalg.solve(root, np.asarray(curve.bends))
    return dataclasses.replace(curve, bends=jnp.asarray(bends), bend_std=jnp.ones(len(size)))


def moved(curve: AbstractFamily, change: Float[np.ndarray, " unknown"]) -> AbstractFamily:
    """A curve after a change of what `curve_columns` calls its unknowns."""
    if isinstance(curve, SmoothingSpline):
        parts = bent(curve)
        values = parts.straight + parts.both @ change
    else:
        known = [1.0, 1.0, 0.0] if isinstance(curve, PowerLaw) else 1.0
        values = np.asarray(curve.parameters) * np.array(known) + change
    return dataclasses.replace(curve, parameters=jnp.asarray(values))
