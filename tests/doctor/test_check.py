"""The import doctor on the exact responses of one mode, each with one error."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim
from truths.one_mode import CUBIC, OMEGA, SHAPE, ZETA, model, noisy, rubbing_test, states, table

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.doctor import findings
from snrmjax.measure import Channel, time_recording


def wrapped(v):
    return np.abs(v) * np.exp(1j * np.degrees(np.angle(v)))


def unsettled(level, v, left=0.5):
    """States with a fraction of the previous one, as at exact resonance."""
    out = v.copy()
    for k in range(1, len(v)):
        if level[k] == level[k - 1]:
            out[k] = v[k] + left * (out[k - 1] - v[k])
    return out


def drifting(w):
    return w * (1 + 0.02 * np.linspace(-0.5, 0.5, len(w)))


def clipped(v, limit):
    """First harmonic of a clipped sine, by its integral over a cycle."""
    phase = 2 * np.pi * (np.arange(720) + 0.5) / 720
    wave = np.clip(np.abs(v)[:, None] * np.cos(phase), -limit, limit)
    return 2 * np.mean(wave * np.cos(phase), axis=1) * np.exp(1j * np.angle(v))


def broken(kind, seed=0):
    """A table with one error and its model."""
    level, w, force, exact = states()
    v, shape = noisy(exact, seed), SHAPE
    if kind == "conjugated_response":
        v = v.conj()
    elif kind == "acceleration_as_velocity":
        v = 1j * w * v
    elif kind == "displacement_as_velocity":
        v = v / (1j * w)
    elif kind == "volts_as_force":
        force = force * np.array([1.0, 0.7, 0.5])[level]
    elif kind == "rms_for_peak":
        v = v / np.sqrt(2)
    elif kind == "degrees_for_radians":
        v = wrapped(v)
    elif kind == "clipped_channel":
        v = clipped(v, 0.5 * np.abs(v).max())
    elif kind == "unsettled_steps":
        v = noisy(unsettled(level, exact), seed)
    elif kind == "force_dropout":
        drop = 1 - 0.6 * np.cos(np.angle(exact)) ** 2
        level, w, _, _ = states()
        w = OMEGA * (1 + 0.05 * np.linspace(-1, 1, 15))[np.arange(45) % 15]
        force = (1.0 + level) * 1.0
        v = 1j * w * SHAPE**2 * force / (OMEGA**2 - w**2 + 2j * ZETA * OMEGA * w)
        drop = 1 - 0.6 * np.cos(np.angle(v)) ** 2
        force, v = force * drop, noisy(v * drop, seed)
    elif kind == "drift":
        w = drifting(w)
    elif kind == "shape_not_mass_normalised":
        shape = 1.0
    return table(level, w, force, v), model(shape)


KINDS = (
    *("conjugated_response", "acceleration_as_velocity", "displacement_as_velocity"),
    *("volts_as_force", "rms_for_peak", "degrees_for_radians", "clipped_channel"),
    *("unsettled_steps", "force_dropout", "drift", "shape_not_mass_normalised"),
)


@pytest.mark.parametrize(
    ("response", "force", "mixed", "correction"),
    [
        (1 / 9.80665, 1, ("response", "g", "m/s²"), ("g", "")),
        pytest.param(
            *(9.80665, 1, ("response", "m/s²", "g"), ("m/s2", "")), marks=pytest.mark.long
        ),
        (1e3, 1, ("response", "mm", "m"), ("mm", "")),
        pytest.param(*(1e6, 1, ("response", "µm", "m"), ("um", "")), marks=pytest.mark.long),
        pytest.param(
            *(39.3701, 1, ("response", "inches", "m"), ("in", "")), marks=pytest.mark.long
        ),
        (1, 1e3, ("force", "mN", "N"), ("", "mN")),
        (1, 1 / 4.44822, ("force", "pounds", "N"), ("", "lbf")),
        pytest.param(*(1, 4.44822, ("force", "N", "pounds"), ("", "N")), marks=pytest.mark.long),
    ],
)
def test_units_that_were_mixed_up_come_first(response, force, mixed, correction):
    level, w, f, v = states()
    findings = sj.doctor.check_test(
        table(level, w, force * f, response * noisy(v)), model()
    ).findings
    assert [one.kind for one in findings] == list(UNIT_FIRST)
    assert [one.severity for one in findings] == ["error", "warning", "warning"]
    assert mixed in findings[0].evidence["units"]
    first = findings[0].corrections[0]
    assert (first.unit, first.force_unit) == correction
    assert first.response / first.force * response / force == pytest.approx(1, rel=1e-5)
    assert all(one.evidence["scale"].kind == "if_units_are_right" for one in findings[1:])


UNIT_FIRST = ("wrong_unit", "volts_as_force", "shape_not_mass_normalised")


@pytest.mark.parametrize("factor", [0.55, 0.75 / 9.80665, 700])
def test_a_factor_between_no_units_is_none_of_theirs(factor):
    level, w, force, v = states()
    checkup = sj.doctor.check_test(table(level, w, force, factor * noisy(v)), model())
    assert checkup.kinds == UNIT_FIRST[1:]


def test_a_potential_that_agrees_points_to_the_force():
    """¾γa² of the model's own cubic spring, 3.7 % of the frequency: the response is right."""
    level, w, force, v = states()
    cubic = sj.model.polynomial_potential({"1111": CUBIC / 4}, 1)
    structure = sj.model.structure(model().modes, cubic)
    checkup = sj.doctor.check_test(table(level, w, force * 1e-3, noisy(v)), structure)
    assert checkup.kinds == UNIT_FIRST[:2]
    assert {column for column, *_ in checkup.findings[0].evidence["units"]} == {"force"}


def raised(checkup):
    return [one.kind for one in checkup.findings if one.severity != "info"]


SLOW = {"volts_as_force", "clipped_channel", "unsettled_steps", "degrees_for_radians"}


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.long) if k in SLOW else k for k in KINDS]
)
def test_each_error_of_a_table_is_reported_alone(kind):
    data, structure = broken(kind)
    checkup = sj.doctor.check_test(data, structure)
    assert raised(checkup) == [kind]
    (row,) = checkup.to_xarray().kind.values
    assert row == kind
    assert kind in repr(checkup)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_other_noise_changes_no_finding(kind):
    for seed in (1, 2, 3):
        assert raised(sj.doctor.check_test(*broken(kind, seed))) == [kind]


@pytest.mark.long
def test_good_tables_have_no_findings_with_any_noise():
    level, w, force, exact = states()
    for seed in range(3, 40):
        assert sj.doctor.check_test(table(level, w, force, noisy(exact, seed)), model()).kinds == ()


def test_good_tables_have_no_findings():
    level, w, force, exact = states()
    for seed in range(2):
        assert sj.doctor.check_test(table(level, w, force, noisy(exact, seed)), model()).kinds == ()


@pytest.mark.long
@pytest.mark.parametrize("ratio", [1.04, 0.5])
def test_files_of_two_structures_are_distinguished(ratio):
    tests = []
    for seed, one in enumerate((1.0, ratio)):
        level, w, force, exact = states(ratio=one)
        tests.append(table(level, w, force, noisy(exact, seed)))
    checkup = sj.doctor.check_test(tests, model())
    assert raised(checkup) == ["different_structures"]
    assert abs(checkup.findings[0].evidence["change"] - (ratio - 1)) < 0.002
    level, w, force, exact = states()
    tests[1] = table(level, w, force, noisy(exact, 5))
    assert sj.doctor.check_test(tests, model()).kinds == ()


def test_friction_is_not_a_wrong_force_scale():
    """Damping that falls as 1/a, exactly: without a model this must not look like volts."""
    assert sj.doctor.check_test(rubbing_test(3)).kinds == ()


def harmonic_table(ratio):
    level, w, force, v = states()
    w3 = 3 * w
    of_force = ratio * force * SHAPE**2 * 1j * w3
    of_force = of_force / (OMEGA**2 - w3**2 + 2j * ZETA * OMEGA * w3)
    q = np.abs(v) / w / SHAPE  # γq³ gives γa³/4 of order 3, in phase with the displacement's cube
    own = -CUBIC * q**3 / 4 * (np.exp(1j * np.angle(v)) / 1j) ** 3
    own = own * SHAPE * 1j * w3 / (OMEGA**2 - w3**2 + 2j * ZETA * OMEGA * w3)
    rng = np.random.default_rng(1)
    floor = 1e-4 * np.abs(v).max()
    noise = floor / np.sqrt(2) * (rng.normal(size=len(v)) + 1j * rng.normal(size=len(v)))
    h = (of_force + own + noise)[:, None, None]
    more = {"harmonics": h, "harmonic_order": (3,), "harmonic_std": np.full((len(v), 1), floor)}
    return table(level, w, force, noisy(v), **more)


def test_harmonics_of_the_force_and_of_the_structure_are_distinguished():
    assert raised(sj.doctor.check_test(harmonic_table(0.15), model())) == ["force_harmonics"]
    assert sj.doctor.check_test(harmonic_table(0.0), model()).kinds == ()


def record(kind="", dwell=1.0, rate=1500.0):
    """Five steps over the resonance of one mode, by scipy's exact step between samples."""
    frequencies = np.linspace(57, 63, 5)
    each = int(dwell * rate)
    phase = 2 * np.pi * np.cumsum(np.repeat(frequencies, each)) / rate
    time = np.arange(len(phase)) / rate
    force = np.cos(phase) + (0.1 * np.cos(3 * phase) if kind == "force_harmonics" else 0.0)
    if kind == "force_dropout":
        force = force * np.repeat([1.0, 0.9, 0.4, 0.9, 1.0], each)
    v = lsim(([1, 0], [1, 2 * ZETA * OMEGA, OMEGA**2]), force, time)[1]
    largest = np.abs(v).max()
    if kind == "missing_anti_alias":
        v = v + 0.02 * largest * np.cos(23 * phase)  # above half the rate: aliased by sampling
    rng = np.random.default_rng(0)
    v = v + 1e-3 * largest * rng.normal(size=len(v))
    if kind == "clipped_channel":
        v = np.clip(v, -0.6 * largest, 0.6 * largest)
    channels = [Channel("cell", "force", "N"), Channel("tip", "velocity", "m/s")]
    return time_recording(np.stack([force, v]), channels, rate)


RECORDS = ("force_harmonics", "force_dropout", "missing_anti_alias", "clipped_channel")


@pytest.mark.parametrize("kind", RECORDS)
def test_each_error_of_a_record_is_reported_alone(kind):
    assert set(raised(sj.doctor.check_test([], None, [record(kind)]))) == {kind}


# Kinds of more than one file or column, by the file with their test.
ELSEWHERE = {
    "wrong_unit": "test_check.py",
    "different_structures": "test_check.py",
    "motion_of_base": "test_moving_bases_and_radians.py",
}


def test_every_kind_of_finding_is_produced_by_a_test():
    missing = {*findings.KINDS} - {*KINDS, *RECORDS, *ELSEWHERE}
    assert not missing, f"add {missing} to `broken` and KINDS, or to `record` and RECORDS, here."
    for kind, file in ELSEWHERE.items():
        text = Path(__file__).with_name(file).read_text("utf-8")
        assert text.count(f'"{kind}"') > (file == Path(__file__).name), f"{file} lacks {kind}"


def test_steps_that_end_too_soon():
    # 0.25 s are 1.9 decay times 1/(ζω): 15 % of a change is left.
    assert raised(sj.doctor.check_test([], None, [record(dwell=0.25)])) == ["unsettled_steps"]


def test_a_good_record_has_no_findings():
    assert sj.doctor.check_test([], None, [record()]).kinds == ()


def test_nothing_to_check():
    with pytest.raises(ValueError, match="nothing to check"):
        sj.doctor.check_test([])


def test_the_command_writes_the_contracts_list(tmp_path):
    from typer.testing import CliRunner

    data, structure = broken("conjugated_response")
    sj.io.write_steady_states(tmp_path / "measured.csv", data)
    sj.io.write_model(tmp_path / "model.toml", structure)
    arguments = ["check", str(tmp_path / "measured.csv"), "--model", str(tmp_path / "model.toml")]
    result = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    (one,) = json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))
    assert set(one) == {"kind", "severity", "where", "evidence", "mend"}
    assert one["kind"] == "conjugated_response"
