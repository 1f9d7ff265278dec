"""A joint fit as tables, as part of a summary, and as a file that gives it back."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.curves.families import FAMILIES
from snrmjax.identify.curves.family_base import AbstractFamily
from snrmjax.identify.inference.contributions import Contribution
from snrmjax.identify.inference.fitted_curves import values_to_the_largest
from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.inference.located_points import FittedPoint
from snrmjax.identify.inference.optimal_design import NextMeasurement, NextMeasurements
from snrmjax.identify.joint.family_fit import FitStatus
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    BalanceProblem,
    PriorStd,
    Unknowns,
)
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.notes import NoiseEstimate
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.io.files import FilePath, read_text, write_atomically
from snrmjax.io.results import write_values
from snrmjax.io.tables import write_table
from snrmjax.io.units import HERTZ
from snrmjax.model.modes import LinearModes, LinearModesStd, RigidBodyModes, linear_modes
from snrmjax.numerics.facts import Fact

BAND_POINTS = 200
_FORMAT = 3


def write_fitted_backbone(
    path: FilePath, fit: JointFit, *, added: tuple[str, int] | None = None
) -> None:
    """Write both fitted curves with 1σ from zero to the largest measured velocity.

    Arguments: `added` as for `write_values`.
    """
    write_values(path, values_to_the_largest(fit, BAND_POINTS), added=added)


def write_next(path: FilePath, advice: Sequence[NextMeasurement] | NextMeasurements) -> None:
    """Write the advised measurements, the best first.

    Where only the drive is known a column `drive_v` has it, and `force_n` is by the gain that the
    fit found.
    """
    columns: dict[str, Sequence[object]] = {
        "rank": [one.rank for one in advice],
        "force_n": [one.force for one in advice],
        "frequency_hz": [one.frequency / HERTZ for one in advice],
        "expected_band_ratio": [one.expected_band_ratio for one in advice],
        "reason": [f"expected {one.expected}: {one.reason}" for one in advice],
    }
    drives = [one.drive for one in advice if one.drive is not None]
    if drives or (isinstance(advice, NextMeasurements) and advice.drive_known_only):
        columns["drive_v"] = drives
    write_table(path, columns)


def summarise_fit(
    fit: JointFit, responses: Sequence[FittedResponse], shares: Sequence[Contribution] = ()
) -> dict:
    """What a joint fit found, by name, in the units of the files."""
    std = np.sqrt(np.diag(fit.covariance))
    vector = np.asarray(fit.vector()[0])
    linear = len(fit.unknowns.linear)
    shown = len(vector) - fit.data.n_levels * len(LEVEL_ERRORS) - linear
    level = dict(zip(LEVEL_ERRORS, np.asarray(fit.noise.level_std).tolist(), strict=True))
    return {
        "converged": fit.converged,
        "status": fit.status.name.lower(),
        "backbone": described(fit.unknowns.squared_frequency),
        "damping": described(fit.unknowns.modal_damping),
        "parameters": {
            name: {"value": float(value), "std": float(spread), "unit": unit}
            for name, value, spread, unit in list(
                zip(fit.names(), vector, std, fit.units(), strict=True)
            )[:shown]
        },
        "covariance": fit.covariance[:shown, :shown].tolist(),
        "noise": {
            "stated": fit.noise.stated,
            "scale": fit.noise.scale,
            "scale_std": fit.noise.scale_std,
            "correlation_of_neighbours": float(np.max(fit.noise.autocorrelation)),
            "wandering_of_natural_frequency": 0.5 * float(fit.data.std[0, 3]),
        },
        "levels": {
            "gain_std": level["gain"],
            "phase_std_deg": float(np.degrees(level["phase"])),
            "natural_frequency_std_relative": 0.5 * level["stiffness"],
            "damping_std_relative": level["damping"],
        },
        "modal_mass": _modal_mass(fit),
        "contributions": [one._asdict() for one in shares],
        "resonances": [_point(p) for r in responses for p in r.resonances],
        "folds": [_point(p) for r in responses for p in r.folds],
        "not_located": [
            {"kind": p.kind, "force_n": p.force, "frequency_hz": p.frequency / HERTZ}
            for r in responses
            for p in r.not_located
        ],
        "notes": [str(note) for note in fit.notes],
    }


def _modal_mass(fit: JointFit) -> dict:
    """The modal mass that damping is relative to, in kg, and whether it is the model's."""
    mass = float(fit.problem.modal_mass_of(fit.unknowns))
    prior = float(fit.prior.linear[-1])
    return {
        "value_kg": mass,
        "std_kg": mass * prior * float(np.sqrt(fit.covariance[-1, -1])),
        "model_kg": 1 / abs(float(fit.problem.modal_constant)),
        "found": prior > 0,
    }


def described(family: AbstractFamily) -> str:
    """A family as the command takes it."""
    return family.label


def _point(point: FittedPoint) -> dict:
    return {
        "force_n": point.force,
        "frequency_hz": point.frequency / HERTZ,
        "frequency_std_hz": point.frequency_std / HERTZ,
        "velocity_m_s": point.velocity,
        "velocity_std_m_s": point.velocity_std,
        "beyond_the_data": point.continued,
    }


def write_joint_fit(path: FilePath, fit: JointFit) -> None:
    """Write a joint fit, its data and covariance included, as JSON that `read_joint_fit` reads."""
    write_atomically(Path(path), json.dumps(_encoded(_content(fit)), allow_nan=True) + "\n")


def _content(fit: JointFit) -> dict:
    unknowns = fit.unknowns
    return {
        "format": _FORMAT,
        "names": list(fit.names()),
        "units": list(fit.units()),
        "covariance": fit.covariance,
        "squared_frequency": _family_entry(unknowns.squared_frequency),
        "modal_damping": _family_entry(unknowns.modal_damping),
        "unknowns": {
            name: getattr(unknowns, name)
            for name in ("log_force_gain", "force_offset", "instrument_phase", "level", "linear")
        },
        "spread": vars(fit.prior),
        "data": vars(fit.data),
        "modes": vars(fit.modes),
        "residuals": fit.residuals,
        "level_std": fit.noise.level_std,
        "neighbour_correlation": fit.noise.autocorrelation,
        "noise_scale": fit.noise.scale,
        "noise_scale_std": fit.noise.scale_std,
        "noise_stated": fit.noise.stated,
        "drive_known_only": fit.drive_known_only,
        "free": fit.free,
        "notes": [str(note) for note in fit.notes],
        "converged": fit.converged,
        "status": fit.status,
        "level_numbers": fit.level_numbers,
    }


def read_joint_fit(path: FilePath) -> JointFit:
    """Read a joint fit that `write_joint_fit` wrote.

    Raises `ValueError` when the file is none, and what opening it raises.
    """
    try:
        content = _decoded(json.loads(read_text(path)))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no joint fit: {error}.") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(f"{path} is no joint fit of format {_FORMAT}.")
    return _rebuilt(content)


def _rebuilt(content: dict[str, Any]) -> JointFit:
    data, modes = content["data"], content["modes"]
    keys = ("natural_frequency", "damping_ratio", "mode_shape", "participation")
    rebuilt: LinearModes = linear_modes(
        *(modes[key] for key in keys),
        sensors=tuple(modes["sensors"]),
        mode_of_interest=modes["mode_of_interest"],
        rigid_body=RigidBodyModes(modes["rigid_body_shape"], modes["rigid_body_participation"]),
        std=LinearModesStd(*(modes.get(f"{name}_std") for name in LinearModesStd._fields)),
    )
    squared, damping = (
        _family(content["squared_frequency"]),
        _family(content["modal_damping"]),
    )
    arrays = {k: jnp.asarray(v) for k, v in content["unknowns"].items()}
    prior = PriorStd(**{name: jnp.asarray(std) for name, std in content["spread"].items()})
    # Files written before a fit had a status know only whether it converged.
    known = FitStatus.CONVERGED if content["converged"] else FitStatus.NOT_SETTLED
    return JointFit(
        unknowns=Unknowns(squared_frequency=squared, modal_damping=damping, **arrays),
        covariance=np.asarray(content["covariance"]),
        problem=BalanceProblem(BalanceData(**_on_device(data)), rebuilt, prior),
        noise=NoiseEstimate(
            scale=content["noise_scale"],
            scale_std=content["noise_scale_std"],
            level_std=np.asarray(content["level_std"]),
            autocorrelation=np.asarray(content.get("neighbour_correlation", [0.0, 0.0])),
            stated=content["noise_stated"],
        ),
        residuals=np.asarray(content["residuals"]),
        drive_known_only=content["drive_known_only"],
        free=tuple(content["free"]),
        notes=tuple(Fact("as_in_file", text=note) for note in content["notes"]),
        status=FitStatus(content.get("status", known)),
        level_numbers=tuple(content.get("level_numbers", range(data["n_levels"]))),
    )


def _family_entry(family: AbstractFamily) -> dict:
    return {"kind": family.kind, **vars(family)}


def _family(entry: dict[str, Any]) -> AbstractFamily:
    return FAMILIES[entry["kind"]](**_on_device({k: v for k, v in entry.items() if k != "kind"}))


def _on_device(fields: dict[str, Any]) -> dict[str, Any]:
    return {k: jnp.asarray(v) if isinstance(v, np.ndarray) else v for k, v in fields.items()}


def _encoded(value: object) -> object:
    """Arrays as objects that say their type and shape; everything else as JSON has it."""
    if isinstance(value, dict):
        return {key: _encoded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "dtype"):
        array = np.asarray(value)
        parts = [array.real, array.imag] if np.iscomplexobj(array) else [array]
        return {
            "array": [part.reshape(-1).tolist() for part in parts],
            "shape": list(array.shape),
            "type": array.dtype.name,
        }
    return value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    if not isinstance(value, dict):
        return value
    if set(value) != {"array", "shape", "type"}:
        return {key: _decoded(item) for key, item in value.items()}
    parts = [np.asarray(part, dtype=np.float64) for part in value["array"]]
    array = parts[0] + 1j * parts[1] if len(parts) == 2 else parts[0]
    return array.astype(value["type"]).reshape(value["shape"])
