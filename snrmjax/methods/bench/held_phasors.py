"""Errors of what a controller holds: of phasors of a record, and of the curve's own argument."""

import numpy as np
from jaxtyping import Float

from snrmjax.methods.result import MethodPoint, MethodStatus

HANN = 1.5  # noise bandwidth of a Hann window, over that of none
PARTS = 10  # of a record, for its scatter
_MOST_HARMONICS = 9  # that a record may have beside its noise
_SAME_VELOCITY = 0.02  # relative difference: levels that say nothing of a slope


def noise_of_sample(
    signal: Float[np.ndarray, " sample"], angle: Float[np.ndarray, " sample"]
) -> float:
    """1σ of a sample: what the mean and the harmonics of the drive leave of a record."""
    design, solved = _series(signal, angle)
    return float(np.std(signal - design @ solved))


def scatter_of_ratio(
    force: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    angle: Float[np.ndarray, " sample"],
) -> float:
    """1σ of the mean force over velocity, relative: of either part, from the parts of a record."""
    parts = np.array_split(np.arange(len(angle)), PARTS)
    each = np.array(
        [_fundamental(force[k], angle[k]) / _fundamental(velocity[k], angle[k]) for k in parts]
    )
    spread = np.abs(each - each.mean()) / abs(each.mean())
    return float(np.sqrt(np.sum(spread**2) / (2 * (PARTS - 1) * PARTS)))


def with_velocity_errors(
    points: list[MethodPoint], velocity_std: Float[np.ndarray, " level"]
) -> list[MethodPoint]:
    """Points whose 1σ hold that their own velocity (1σ relative) is not exact."""
    found = [k for k, one in enumerate(points) if one.status == MethodStatus.FOUND]
    at = np.log([points[k].velocity for k in found])
    order = np.argsort(at)
    if len(found) < 2 or not np.all(np.diff(at[order]) > _SAME_VELOCITY):
        return points
    moved = list(points)
    curves = np.array([(points[k].natural_frequency, points[k].damping_ratio) for k in found])
    slopes = np.empty_like(curves)
    slopes[order] = np.gradient(curves[order], at[order], axis=0)
    for k, (frequency, ratio) in zip(found, slopes * velocity_std[found, None], strict=True):
        one = points[k]
        moved[k] = one._replace(
            natural_frequency_std=float(np.hypot(one.natural_frequency_std, frequency)),
            damping_ratio_std=float(np.hypot(one.damping_ratio_std, ratio)),
        )
    return moved


def _fundamental(signal: np.ndarray, angle: np.ndarray) -> complex:
    _, solved = _series(signal, angle)
    return complex(solved[1] - 1j * solved[1 + _MOST_HARMONICS])


def _series(signal: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean, cosines and sines of the drive's harmonics, and their amplitudes in the record."""
    turns = angle[:, None] * np.arange(1, _MOST_HARMONICS + 1)
    design = np.concatenate([np.ones((len(angle), 1)), np.cos(turns), np.sin(turns)], axis=1)
    return design, np.linalg.lstsq(design, signal, rcond=None)[0]
