"""What a set is written as: noise, the table, the baseline model and the key."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import tomli_w
from effects import Effect
from flat_beam import FLAT_BEAM
from plans import HALVES, Case
from strength import AMPLITUDE_STD, FORCE_STD, PHASE_STD
from truth import Truth

SENSOR = "midspan"


def physical_parameters(case: Case, effect: Effect, truth: Truth) -> dict[str, float]:
    """The parameters of one effect in the units of the model file, by `kind.parameter`."""
    omega, size = 2 * np.pi * case.natural_frequency_hz, case.displacement
    stiffness = omega**2
    unit = {
        "cubic_stiffness.coefficient": stiffness / size**2,
        "quadratic_stiffness.coefficient": stiffness / size,
        "quintic_stiffness.coefficient": stiffness / size**4,
        "coulomb_friction.force": stiffness * size,
        "static_preload.constant_force": stiffness * size,
        "quadratic_damping.coefficient": 1 / size,
        "cubic_damping.coefficient": 1 / (omega * size**2),
        "van_der_pol_damping.coefficient": omega / size**2,
        "force_offset_error.offset": stiffness * size / case.participation,
        "residual_mode.receptance": case.shape * case.participation / stiffness,
        "mode_shape_change.coefficient": 1 / size**2,
        "internal_resonance_1_3.coefficient": stiffness / size**2,
        "internal_resonance_1_2.coefficient": stiffness / size,
        "internal_resonance_1_3.frequency": case.natural_frequency_hz,
        "internal_resonance_1_2.frequency": case.natural_frequency_hz,
    }
    for kind in ("bilinear_stiffness", "gap_stiffness", "one_sided_stop", "jenkins_slider"):
        unit |= {f"{kind}.stiffness": stiffness, f"{kind}.gap": size}
    unit["jenkins_slider.slip_displacement"] = size
    values = {name: value * unit.get(name, 1.0) for name, value in effect.parameters.items()}
    if effect.kind == "iwan_microslip":
        power = values["iwan_microslip.exponent"]
        values["iwan_microslip.coefficient"] *= stiffness * size ** (1 - power)
    if effect.kind == "frequency_drift":
        drift = values["frequency_drift.relative_drift"]
        values["frequency_drift.relative_drift"] = (
            drift * truth.span / (1 + drift * truth.first_clock)
        )
    if effect.kind == "frequency_jump":
        at = values["frequency_jump.at"]
        values["frequency_jump.at"] = (at - truth.first_clock) / truth.span
    if effect.kind.startswith("internal_resonance"):
        values[f"{effect.kind}.frequency_hz"] = values.pop(f"{effect.kind}.frequency")
    return values


def true_frequency_hz(case: Case, truth: Truth) -> float:
    """ω₀/2π at the first recorded state: a drift is counted from there."""
    drift = sum(e.parameters.get("frequency_drift.relative_drift", 0.0) for e in case.effects)
    return case.natural_frequency_hz * (1 + drift * truth.first_clock)


def table(case: Case, truth: Truth) -> dict[str, np.ndarray]:
    """The columns of the table: true states with the errors of the test."""
    rng = np.random.default_rng(case.noise_seed)
    omega, n = 2 * np.pi * case.natural_frequency_hz, len(truth.level)
    speed = omega * case.displacement * case.shape
    harmonic = case.errors.harmonic * speed
    levels = np.unique(truth.level, return_inverse=True)[1]
    gain = case.errors.level_gain * rng.normal(size=levels.max() + 1)[levels]
    phase = case.errors.level_phase * rng.normal(size=levels.max() + 1)[levels]
    gain = (1 + gain) * (1 + AMPLITUDE_STD * rng.normal(size=n))
    phase = phase + PHASE_STD * rng.normal(size=n)
    orders = np.arange(len(truth.velocity))[:, None]
    velocity = truth.velocity * speed * gain * np.exp(1j * orders * phase)
    floor = rng.normal(size=(2, *velocity.shape)) * harmonic / np.sqrt(2)
    floor[:, 1] = 0.0  # the fundamental's noise is stated by amplitude and phase
    velocity = velocity + floor[0] + 1j * floor[1]
    force = truth.force * omega**2 * case.displacement / case.participation
    force = force * (1 + FORCE_STD * rng.normal(size=n))
    stated = case.plan.stated_over_true
    columns = {
        "level": truth.level,
        "frequency_hz": truth.frequency * case.natural_frequency_hz,
        "force_n": force,
        "velocity_re_m_s": velocity[1].real,
        "velocity_im_m_s": velocity[1].imag,
        "velocity_std_m_s": stated * AMPLITUDE_STD * np.abs(velocity[1]),
        "phase_std_deg": np.full(n, stated * np.degrees(PHASE_STD)),
        "force_std_n": stated * FORCE_STD * force,
    }
    if case.with_order:
        columns["order"] = truth.order
    if case.plan.harmonics:
        columns["velocity_h0_m_s"] = velocity[0].real
        for h in (2, 3):
            columns[f"velocity_h{h}_re_m_s"] = velocity[h].real
            columns[f"velocity_h{h}_im_m_s"] = velocity[h].imag
        columns["harmonic_std_m_s"] = np.full(n, stated * harmonic)
    return columns


def baseline_model(case: Case, truth: Truth) -> dict:
    """The model that lacks the effect: truth with the errors of the linear test."""
    rng = np.random.default_rng([*case.seed, 9])
    errors, stiffness = case.errors, (2 * np.pi * case.natural_frequency_hz) ** 2
    off = rng.normal(size=3)
    frequency = true_frequency_hz(case, truth)
    mode = {
        "frequency_hz": frequency * (1 + errors.frequency * off[0]),
        "damping_ratio": case.base.damping * (1 + errors.damping * off[1]),
        "shape": {SENSOR: case.shape},
        "participation": case.participation,
        "frequency_std_hz": frequency * errors.frequency,
        "damping_ratio_std": case.base.damping * errors.damping,
    }
    model: dict = {"name": case.name.replace("_", " "), "mode": [mode]}
    quartic = case.base.cubic * stiffness / case.displacement**2 / 4
    potential: dict = {}
    if case.on_a_beam:
        quartic = FLAT_BEAM.potential["1111"]
        potential = dict(FLAT_BEAM.potential)
        linear = list(
            zip(
                FLAT_BEAM.frequency_hz, FLAT_BEAM.damping_ratio, FLAT_BEAM.shape,
                FLAT_BEAM.participation, strict=True,
            )
        )  # fmt: skip
        model["mode"] += [
            {"frequency_hz": f, "damping_ratio": z, "shape": {SENSOR: s}, "participation": p}
            for f, z, s, p in linear[1:]
        ]
    if quartic:
        potential["1111"] = {
            "coefficient": quartic * (1 + errors.cubic * off[2]),
            "std": abs(quartic) * errors.cubic,
        }
        model["potential"] = potential
    if case.plan.level_errors:
        model["measurement"] = {
            "level_gain_std": errors.level_gain,
            "level_phase_std_deg": float(np.degrees(errors.level_phase)),
        }
    return model


def key(case: Case, truth: Truth) -> dict:
    """The truth about one set."""
    plan = case.plan
    outside = plan.group in ("outside", "law")
    parameters: dict[str, float] = {}
    for effect in case.effects:
        parameters |= physical_parameters(case, effect, truth)
    stated = "right"
    if plan.stated_over_true != 1:
        stated = "too_small" if plan.stated_over_true < 1 else "too_large"
    return {
        "name": case.name,
        "half": HALVES[case.seed[1]],
        "seed": [int(k) for k in case.seed],
        "group": plan.group,
        "effects": [] if outside else [e.kind for e in case.effects],
        "outside": case.effects[0].kind if outside else None,
        "parameters": {n: float(v) for n, v in parameters.items()},
        "parameters_scaled": outside,
        "strength": plan.strength,
        "noise_units_wanted": case.wanted,
        "noise_units": {n: round(v, 3) for n, v in truth.units.items()},
        "noise_stated": stated,
        "stated_over_true": plan.stated_over_true,
        "harmonics": plan.harmonics,
        "level_errors": plan.level_errors,
        "structure": "flat beam" if case.on_a_beam else "one mode",
        "baseline": {
            "frequency_hz": true_frequency_hz(case, truth),
            "damping_ratio": case.base.damping,
            "cubic": case.base.cubic,
            "displacement_scale": case.displacement,
            "shape": case.shape,
            "largest": float(np.max(np.abs(truth.velocity[1]) / truth.frequency)),
            "fastest": float(np.max(np.abs(truth.velocity[1]))),
        },
        "levels": len(case.base.peaks),
        "rows": len(truth.level),
        "jumps": int(truth.jumps),
        "frequencies_left_out": int(truth.left_out),
        "worst_residual": truth.residual,
    }


def write_set(
    case: Case,
    truth: Truth,
    sets: Path,
    keys: Path,
    columns: Mapping[str, np.ndarray] | None = None,
    request: Mapping | None = None,
) -> None:
    """Write one set and, apart from it, its key.

    `columns` are the table if it is another one than the truth with the errors of the test, since a
    further measurement was asked for by `request`. What is NaN was not measured.
    """
    columns = table(case, truth) if columns is None else columns
    lines = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(",".join(_text(v) for v in row))
    (sets / f"{case.name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    model = tomli_w.dumps(baseline_model(case, truth))
    (sets / f"{case.name}.toml").write_text(model, encoding="utf-8")
    text = json.dumps(key(case, truth) | {"request": request}, indent=1)
    (keys / f"{case.name}.json").write_text(text + "\n", encoding="utf-8")


def _text(value: np.number) -> str:
    if isinstance(value, np.integer):
        return f"{value:d}"
    return f"{value:.8g}" if np.isfinite(value) else ""
