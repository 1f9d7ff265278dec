"""Results as tables and as one summary: what the commands write."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues
from snrmjax.identify.pointwise.identification import Identification
from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.identify.pointwise.prediction import PredictedResponse, Resonance
from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.io.tables import write_table
from snrmjax.io.units import HERTZ
from snrmjax.measure.signals import peak_amplitude
from snrmjax.model.structures import Structure
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

BACKBONE_POINTS = 200


def write_response(path: Path, model: Structure, curves: Sequence[ResponseCurve]) -> None:
    """Write simulated responses at the sensor that sees the mode of interest best."""
    r = reference_sensor(model.modes)
    force = np.concatenate([np.full(len(c.frequency), c.force) for c in curves])
    fundamental = np.concatenate([c.velocity[:, 1, r] for c in curves])
    write_table(
        path,
        {
            "force_n": force,
            "point": _numbered(force),
            "frequency_hz": np.concatenate([c.frequency for c in curves]) / HERTZ,
            "velocity_h1_re_m_s": fundamental.real,
            "velocity_h1_im_m_s": fundamental.imag,
            "velocity_peak_m_s": _peaks(np.concatenate([c.velocity[:, :, r] for c in curves])),
            "stable": np.concatenate([c.stable for c in curves]),
            "event": [event for c in curves for event in c.event],
        },
    )


def write_normal_mode(path: Path, model: Structure, branch: NormalModeBranch) -> None:
    """Write a nonlinear normal mode at the sensor that sees it best."""
    r = reference_sensor(model.modes)
    write_table(
        path,
        {
            "point": np.arange(len(branch.frequency)),
            "frequency_hz": branch.frequency / HERTZ,
            "velocity_h1_m_s": np.abs(branch.velocity[:, 1, r]),
            "velocity_peak_m_s": _peaks(branch.velocity[:, :, r]),
            "energy_j": branch.energy,
        },
    )


def write_points(path: Path, identification: Identification) -> None:
    """Write the identified points, one row a steady state."""
    points = identification.points
    write_table(
        path,
        {
            "level": points.level,
            "frequency_hz": np.asarray(points.frequency) / HERTZ,
            "force_n": points.force,
            "velocity_m_s": np.abs(np.asarray(points.velocity)),
            "phase_deg": np.degrees(np.angle(np.asarray(points.velocity))),
            "nnmai": points.appropriation,
            "natural_frequency_hz": np.asarray(points.natural_frequency) / HERTZ,
            "natural_frequency_std_hz": np.asarray(points.natural_frequency_std) / HERTZ,
            "damping_ratio": points.damping_ratio,
            "damping_ratio_std": points.damping_ratio_std,
            "backbone_velocity_m_s": points.backbone_velocity,
            "status": [PointStatus(int(s)).name.lower() for s in np.asarray(points.status)],
        },
    )


def write_backbone(path: Path, identification: Identification) -> None:
    """Write the backbone with its 1σ between the smallest and the largest point used.

    An anchored backbone starts at zero amplitude.
    """
    backbone = identification.fit.backbone
    start = 0.0 if identification.fit.anchor is not None else float(backbone.smallest)
    write_values(path, _sampled(backbone, start))


def write_values(path: Path, values: BackboneValues) -> None:
    """Write natural frequency and damping against velocity, with 1σ."""
    write_table(
        path,
        {
            "velocity_m_s": values.velocity,
            "natural_frequency_hz": np.asarray(values.natural_frequency) / HERTZ,
            "natural_frequency_std_hz": np.asarray(values.natural_frequency_std) / HERTZ,
            "damping_ratio": values.damping_ratio,
            "damping_ratio_std": values.damping_ratio_std,
        },
    )


def write_prediction(path: Path, responses: Sequence[PredictedResponse]) -> None:
    """Write predicted responses at the backbone's sensor; isolated parts follow the main curve."""
    force = np.concatenate([np.full(len(c.frequency), c.force) for c in responses])
    velocity = np.concatenate([c.velocity for c in responses])
    write_table(
        path,
        {
            "force_n": force,
            "point": _numbered(force),
            "frequency_hz": np.concatenate([c.frequency for c in responses]) / HERTZ,
            "velocity_re_m_s": velocity.real,
            "velocity_im_m_s": velocity.imag,
            "stable": np.concatenate([c.stable for c in responses]),
        },
    )


def summarise(
    identification: Identification, predictions: Sequence[tuple[float, Sequence[Resonance]]]
) -> dict:
    """The headline numbers of an identification, by name, in the units of the files."""
    points, fit = identification.points, identification.fit
    backbone = fit.backbone
    values = _sampled(backbone, float(backbone.smallest))
    frequency = np.asarray(values.natural_frequency) / HERTZ
    damping, velocity = values.damping_ratio, values.velocity
    status = np.asarray(points.status)
    anchor = fit.anchor
    return {
        "sensor": points.sensor,
        "amplitude": points.argument,
        "points": {
            kind.name.lower(): int(np.sum(status == kind))
            for kind in PointStatus
            if np.any(status == kind)
        },
        "backbone": {
            "velocity_m_s": [float(velocity[0]), float(velocity[-1])],
            "natural_frequency_hz": [float(frequency[0]), float(frequency[-1])],
            "natural_frequency_min_hz": float(frequency.min()),
            "natural_frequency_max_hz": float(frequency.max()),
            "damping_ratio": [float(damping[0]), float(damping[-1])],
            "damping_ratio_min": float(np.min(damping)),
            "damping_ratio_max": float(np.max(damping)),
        },
        "noise": {
            "stated": fit.noise_stated,
            "scale_frequency": fit.noise_scale[0],
            "scale_damping": fit.noise_scale[1],
            "level_frequency_std_hz": fit.level_frequency_std / HERTZ,
            "level_damping_ratio_std": fit.level_damping_std,
        },
        "anchor": None
        if anchor is None
        else {
            "natural_frequency_gap_hz": anchor.frequency_gap / HERTZ,
            "natural_frequency_gap_std_hz": anchor.frequency_gap_std / HERTZ,
            "damping_ratio_gap": anchor.damping_gap,
            "damping_ratio_gap_std": anchor.damping_gap_std,
            "largest_shift_hz": anchor.largest_frequency_shift / HERTZ,
            "largest_damping_ratio_shift": anchor.largest_damping_shift,
        },
        "resonances": [
            {
                "force_n": force,
                "velocity_m_s": resonance.velocity,
                "frequency_hz": resonance.frequency / HERTZ,
                "damping_ratio": resonance.damping_ratio,
                "beyond_the_data": resonance.continued,
            }
            for force, found in predictions
            for resonance in found
        ],
        "notes": list(identification.notes),
    }


def _sampled(backbone: Backbone, start: float) -> BackboneValues:
    amplitude = np.linspace(start, float(backbone.largest), BACKBONE_POINTS)
    return backbone.values(jnp.asarray(amplitude))


def _numbered(force: np.ndarray) -> np.ndarray:
    """Point numbers that start again at 0 with every force."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(force) != 0]))
    return np.arange(len(force)) - np.repeat(starts, np.diff(np.append(starts, len(force))))


def _peaks(velocity: np.ndarray) -> np.ndarray:
    """Peak of the time signal of every point, from its harmonics without the mean (which is 0)."""
    orders = tuple(range(1, velocity.shape[1]))
    return np.asarray(jax.jit(peak_amplitude, static_argnums=1)(velocity[:, 1:], orders))
