"""A joint fit as tables, as a summary, and as a file that can be read back."""

import importlib
import json
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from snrmjax.identify.inference.contributions import Contribution
from snrmjax.identify.inference.fitted_curves import values_to_the_largest
from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.inference.forced_motion import FittedPoint
from snrmjax.identify.inference.optimal_design import NextMeasurement, NextMeasurements
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.io.files import FilePath, read_text, write_atomically
from snrmjax.io.results import load_named, write_values
from snrmjax.io.tables import write_table
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status
from snrmjax.numerics.units import HERTZ

BAND_POINTS = 200
_FORMAT = 6


def write_fitted_backbone(
    path: FilePath, fit: JointFit, *, added: tuple[str, int] | None = None
) -> None:
    """Write both fitted curves with 1σ from zero to the largest measured velocity.

    Arguments: `added` as for `write_values`.
    """
    write_values(path, values_to_the_largest(fit, BAND_POINTS), added=added)


def write_next(
    path: FilePath,
    advice: Sequence[NextMeasurement] | NextMeasurements,
    *,
    force_unit: str = "N",
) -> None:
    """Write the advised measurements, the best first; `force_unit` as for `results.load_named`.

    Where only the drive is known, a column `drive_v` has it, and `force_n` uses the fitted gain.
    """
    columns: dict[str, Sequence[object]] = {
        "rank": [measurement.rank for measurement in advice],
        "force_n": [measurement.force for measurement in advice],
        "frequency_hz": [measurement.frequency / HERTZ for measurement in advice],
        "expected_band_ratio": [measurement.expected_band_ratio for measurement in advice],
        "reason": [
            f"expected {measurement.expected}: {measurement.reason}" for measurement in advice
        ],
    }
    drives = [measurement.drive for measurement in advice if measurement.drive is not None]
    if drives or (isinstance(advice, NextMeasurements) and advice.drive_known_only):
        columns["drive_v"] = drives
    write_table(path, load_named(columns, force_unit))


def summarise_fit(
    fit: JointFit, responses: Sequence[FittedResponse], fractions: Sequence[Contribution] = ()
) -> dict:
    """Results of a joint fit by name, in the units of the files."""
    std, unit = np.sqrt(np.diag(fit.covariance)), fit.modes.force_unit
    vector = np.asarray(fit.vector()[0])
    linear = len(fit.unknowns.linear)
    shown = len(vector) - fit.data.n_levels * len(LEVEL_ERRORS) - linear
    level = dict(zip(LEVEL_ERRORS, np.asarray(fit.noise.level_std).tolist(), strict=True))
    return {
        "converged": fit.converged,
        "status": "converged" if fit.converged else "not_settled",
        "backbone": fit.unknowns.squared_frequency.label,
        "damping": fit.unknowns.modal_damping.label,
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
            "wandering_of_natural_frequency": 0.5 * fit.data.std.item(0, 3),
        },
        "levels": {
            "gain_std": level["gain"],
            "phase_std_deg": float(np.degrees(level["phase"])),
            "natural_frequency_std_relative": 0.5 * level["stiffness"],
            "damping_std_relative": level["damping"],
        },
        "modal_mass": _modal_mass(fit),
        "contributions": [fraction._asdict() for fraction in fractions],
        "resonances": [load_named(_point(p), unit) for r in responses for p in r.resonances],
        "folds": [load_named(_point(p), unit) for r in responses for p in r.folds],
        "not_located": [
            load_named(
                {"kind": p.kind, "force_n": p.force, "frequency_hz": p.frequency / HERTZ}, unit
            )
            for r in responses
            for p in r.not_located
        ],
        "notes": [str(note) for note in fit.notes],
    }


def _modal_mass(fit: JointFit) -> dict:
    """The modal mass (kg) that damping refers to, and whether it was identified."""
    mass = float(fit.problem.modal_mass_of(fit.unknowns))
    prior = fit.prior.linear.item(-1)
    return {
        "value_kg": mass,
        "std_kg": mass * prior * float(np.sqrt(fit.covariance[-1, -1])),
        "model_kg": 1 / abs(float(fit.problem.modal_constant)),
        "found": prior > 0,
    }


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
    content = {"format": _FORMAT, "names": fit.names(), "units": fit.units(), "fit": fit}
    text = json.dumps({name: _encoded(value) for name, value in content.items()}, allow_nan=True)
    write_atomically(path, text + "\n")


def read_joint_fit(path: FilePath) -> JointFit:
    """Read a joint fit that `write_joint_fit` wrote.

    Raises `ValueError` for a file that is no joint fit, and as `read_text` does.
    """
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is no joint fit: {error}.") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise InputError(f"{path} is no joint fit of format {_FORMAT}.")
    fit = _decoded(content.get("fit"))
    if not isinstance(fit, JointFit):
        raise InputError(f"{path} is no joint fit: it contains another object.")
    return fit


def _encoded(value: Any) -> Any:
    """Encode values that JSON lacks as an object whose key gives the type."""
    if isinstance(value, Fact):
        return {"fact": str(value)}
    if isinstance(value, Status):
        return {"status": _class_name(value), "value": int(value)}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        parts = [array.real, array.imag] if np.iscomplexobj(array) else [array]
        return {
            "array": [part.reshape(-1).tolist() for part in parts],
            "shape": list(array.shape),
            "type": array.dtype.name,
            "on_device": isinstance(value, jax.Array),
        }
    if isinstance(value, eqx.Module) or hasattr(value, "_fields"):
        fields = value._fields if hasattr(value, "_fields") else vars(value)
        contents = {name: _encoded(getattr(value, name)) for name in fields}
        return {"class": _class_name(value), "fields": contents}
    if isinstance(value, list | tuple):
        return {"list": [_encoded(item) for item in value]}
    return value


def _class_name(value: Any) -> str:
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _decoded(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    if "fact" in value:
        return Fact("as_in_file", text=value["fact"])
    if "status" in value:
        return _class(value["status"])(value["value"])
    if "list" in value:
        return tuple(_decoded(item) for item in value["list"])
    if "class" in value:
        fields = {name: _decoded(item) for name, item in value["fields"].items()}
        return _class(value["class"])(**fields)
    parts = [np.asarray(part, dtype=np.float64) for part in value["array"]]
    array = parts[0] + 1j * parts[1] if len(parts) == 2 else parts[0]
    array = array.astype(value["type"]).reshape(value["shape"])
    return jnp.asarray(array) if value["on_device"] else array


def _class(name: str) -> Any:
    """A class of this package; no other class is created from a file."""
    module, _, qualified = name.partition(":")
    if not module.startswith("snrmjax.") or not qualified.isidentifier():
        raise InputError(f"a joint fit is not made of {name}.")
    named = getattr(importlib.import_module(module), qualified, None)
    is_allowed = isinstance(named, type) and issubclass(named, tuple | Status | eqx.Module)
    if not is_allowed:
        raise InputError(f"a joint fit is not made of {name}.")
    return named
