"""Closed loop: an open answer recommends a measurement, and the filled plan decides it.

The truth is the closed form of `truths.growing_damping`: a mode whose damping grows as Q², by
cubic damping or by van der Pol's, which differ in their third harmonics only.
"""

import csv
import dataclasses
import json

import numpy as np
import pytest
from scipy.optimize import brentq
from truths.balanced_sets import balanced, quadratic
from truths.balanced_sets import linear_model as balanced_model
from truths.growing_damping import (
    GROWTH,
    NOISE,
    OMEGA,
    PARTICIPATION,
    SHAPE,
    THIRD,
    ZETA,
    linear_model,
    measured,
)
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.diagnose.diagnosis_result import FormerAnswer
from snrmjax.diagnose.measurement_plan import measurement_plan
from snrmjax.diagnose.verdict import NONE, answer_of
from snrmjax.io.measurement_plans import read_former_answer, read_further_states, write_plan
from snrmjax.numerics.facts import Fact


def answer(omega, force, kind, rng):
    """Velocity and its third harmonic as the true structure answers a force, with noise."""

    def dynamic(x):
        return OMEGA**2 - omega**2 + 1j * omega * (2 * ZETA * OMEGA + GROWTH * x**2)

    x = brentq(lambda q: abs(dynamic(q)) * q - force * PARTICIPATION, 0.0, 1.0)
    exact = 1j * omega * x * np.exp(-1j * np.angle(dynamic(x))) * SHAPE
    third = THIRD[kind] * GROWTH * x**2 / omega * abs(exact) * np.exp(3j * np.angle(exact))
    own = np.exp(NOISE["velocity"] * rng.normal() + 1j * NOISE["phase"] * rng.normal())
    return exact * own, third


def fill(path, kind):
    """Fill every empty field of a plan with a measured value, as an engineer would."""
    rng = np.random.default_rng(3)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        omega = 2 * np.pi * float(row["frequency_hz"])
        velocity, third = answer(omega, float(row["force_n"]), kind, rng)
        floor = float(row["harmonic_std_m_s"])
        parts = {"": velocity}
        for order, exact in ((2, 0.0), (3, third)):
            parts[f"h{order}_"] = exact + floor / np.sqrt(2) * complex(*rng.normal(size=2))
        for name, value in parts.items():
            for part, number in (("re", value.real), ("im", value.imag)):
                if f"velocity_{name}{part}_m_s" in row:
                    row[f"velocity_{name}{part}_m_s"] = repr(float(number))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """A folder with an ambiguous diagnosis and its plan, as the command writes them."""
    folder = tmp_path_factory.mktemp("loop")
    sj.io.write_model(folder / "model.toml", linear_model())
    sj.io.write_steady_states(folder / "first.csv", measured())
    run(folder, "--plan", str(folder / "plan.csv"), "--out", str(folder / "one"))
    return folder


def run(folder, *options):
    table, model = str(folder / "first.csv"), str(folder / "model.toml")
    done = CliRunner().invoke(
        app, ["diagnose", table, "--model", model, "--no-responses", *options]
    )
    return done


def refusal(done):
    """The message of a refused command."""
    assert isinstance(done.exception, ValueError)
    return str(done.exception)


@pytest.mark.parametrize(
    "truth", ["van_der_pol_damping", pytest.param("cubic_damping", marks=pytest.mark.long)]
)
def test_the_filled_plan_names_the_truth(asked, truth, tmp_path):
    before = json.loads((asked / "one" / "diagnosis.json").read_text())
    assert before["verdict"] == "ambiguous"
    assert max(before["probabilities"].values()) < 0.7
    plan = tmp_path / "filled.csv"
    plan.write_text((asked / "plan.csv").read_text())
    fill(plan, truth)
    former = str(asked / "one" / "diagnosis.json")
    done = run(asked, "--add", str(plan), "--continue", former, "--out", str(tmp_path / "two"))
    assert done.exit_code == 0
    after = json.loads((tmp_path / "two" / "diagnosis.json").read_text())
    assert after["effects"] == [truth]
    assert after["candidates"] == [[truth]]
    (other,) = set(THIRD) - {truth}
    assert after["probabilities"].get(other, 0.0) < 0.01
    assert any(note.startswith("before the additional states") for note in after["notes"])


def test_an_unfilled_plan_is_refused_by_row_and_column(asked, tmp_path):
    out = tmp_path / "out"
    done = run(asked, "--add", str(asked / "plan.csv"), "--out", str(out))
    message = refusal(done)
    assert "`velocity_re_m_s` must be filled in with what was measured" in message
    assert "row 2 of plan.csv has an empty field" in message
    assert not out.exists()


def test_a_forgotten_harmonic_is_refused_too(asked, tmp_path):
    """An empty harmonic of a data file is not stated; of a plan it was forgotten."""
    plan = tmp_path / "filled.csv"
    plan.write_text((asked / "plan.csv").read_text())
    fill(plan, "cubic_damping")
    with plan.open(newline="") as file:
        rows = list(csv.DictReader(file))
    rows[3]["velocity_h3_re_m_s"] = rows[3]["velocity_h3_im_m_s"] = ""
    with plan.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(
        ValueError, match=r"`velocity_h3_re_m_s` must be filled in .* row 5 of filled\.csv"
    ):
        read_further_states(plan, linear_model(), measured())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--continue", "one/diagnosis.json"), "`--continue` needs further states"),
        (("--add", "plan.csv", "--continue", "model.toml"), "must be a diagnosis.json"),
        (("--plan", "nowhere/plan.csv"), "its folder does not exist"),
        (("first.csv", "--add", "plan.csv"), "`--add` is for one data file, but 2 are given"),
    ],
)
def test_what_cannot_be_continued_is_refused(asked, tmp_path, options, message):
    paths = [one if one.startswith("--") else str(asked / one) for one in options]
    done = run(asked, *paths, "--out", str(tmp_path / "out"))
    assert message in refusal(done)


def test_a_plan_has_what_was_asked_for_at_levels_of_its_own(asked):
    """Three phasor parts to be filled in; levels of the first test are 0 to 4."""
    with (asked / "plan.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    request = json.loads((asked / "one" / "diagnosis.json").read_text())["request"]
    assert len(rows) == request["states"]
    assert {row["level"] for row in rows} == {"5"}
    assert {f"velocity_h{order}_re_m_s" for order in request["harmonics"]} < set(rows[0])
    for row in rows:
        assert row["velocity_re_m_s"] == row["velocity_im_m_s"] == ""
        assert float(row["harmonic_std_m_s"]) == pytest.approx(
            request["harmonic_std_m_s"], rel=0.01
        )
        # The noise is that of the first test.
        assert float(row["phase_std_deg"]) == pytest.approx(np.degrees(NOISE["phase"]), rel=0.01)
        ratio = float(row["force_std_n"]) / float(row["force_n"])
        assert ratio == pytest.approx(NOISE["force"], rel=0.02)


def test_planned_states_resonate_where_the_structure_does(asked):
    """The plan's velocities are those of the true structure at its frequencies and forces."""
    with (asked / "plan.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rng = np.random.default_rng(0)
    for row in rows:
        omega, force = 2 * np.pi * float(row["frequency_hz"]), float(row["force_n"])
        velocity, _ = answer(omega, force, "cubic_damping", rng)
        expected = float(row["velocity_std_m_s"]) / NOISE["velocity"]
        assert abs(velocity) == pytest.approx(expected, rel=0.06)  # 1 % noise, 2 % of the law


def test_what_changed_names_old_and_new_answers():
    a, b, c, d, e = (("a",), ("b",), ("c",), ("d",), ("a", "b"))
    former = FormerAnswer("ambiguous", a, {a: 0.5, b: 0.4, c: 0.1, d: 0.0})
    changed = former.changed_to({b: 0.9, e: 0.1})["probabilities"]
    assert changed == ((a, 0.5, 0.0), (b, 0.4, 0.9), (c, 0.1, 0.0), (e, None, 0.1))


def test_answers_of_a_file_are_those_of_a_diagnosis(tmp_path):
    written = {"verdict": "named", "effects": ["b", "a"], "tried": []}
    written["probabilities"] = {"a+b": 0.9, "none": 0.1}
    (tmp_path / "diagnosis.json").write_text(json.dumps(written))
    former = read_former_answer(tmp_path / "diagnosis.json")
    assert former.probabilities == {answer_of(former.effects): 0.9, NONE: 0.1}


@pytest.fixture(scope="module")
def ambiguous():
    """Quadratic damping without harmonics, as if another law had the same fundamental."""
    found = sj.diagnose_model(balanced_model(), balanced(quadratic))
    asked = Fact("record_harmonics")
    return dataclasses.replace(found, verdict=sj.diagnose.Verdict.AMBIGUOUS, recommended=asked)


def test_where_no_test_was_compared_the_largest_level_is_measured_again(ambiguous):
    assert (ambiguous.verdict, ambiguous.discriminating_test) == ("ambiguous", None)
    plan = measurement_plan(ambiguous)
    first = ambiguous.data.select(np.asarray(ambiguous.data.level) == 4)
    order = np.argsort(first.frequency)
    np.testing.assert_allclose(plan.states.frequency, np.asarray(first.frequency)[order])
    np.testing.assert_allclose(plan.states.force, np.asarray(first.force)[order])
    np.testing.assert_array_equal(plan.states.level, 5)
    assert (plan.harmonics, plan.harmonic_std) == ((2, 3), None)


def test_where_harmonics_are_there_the_range_of_levels_is_widened(ambiguous):
    data = ambiguous.data
    seen = np.full((data.n_states, 1, 2), 1e-3 + 0j)
    known = dataclasses.replace(data, harmonics=seen, harmonic_order=(2, 3))
    plan = measurement_plan(dataclasses.replace(ambiguous, data=known))
    force, level = np.asarray(plan.states.force), np.asarray(plan.states.level)
    before, own = np.asarray(data.force), np.asarray(data.level)
    assert set(level) == {5, 6}
    assert force[level == 5].max() == pytest.approx(0.5 * before[own == 0].max())
    assert force[level == 6].max() == pytest.approx(1.5 * before[own == 4].max())


def test_a_plan_states_no_errors_where_none_were_stated(ambiguous, tmp_path):
    silent = {name: np.full((45, 1), np.nan) for name in ("velocity_std", "phase_std")}
    data = dataclasses.replace(ambiguous.data, force_std=np.full(45, np.nan), **silent)
    write_plan(tmp_path / "plan.csv", measurement_plan(dataclasses.replace(ambiguous, data=data)))
    with (tmp_path / "plan.csv").open(newline="") as file:
        (header, *rows) = csv.reader(file)
    assert [name for name in header if "std" in name] == ["harmonic_std_m_s"]
    assert len(rows) == 9


def test_a_decided_answer_has_no_plan(ambiguous):
    for verdict in (sj.diagnose.Verdict.NAMED, sj.diagnose.Verdict.NOISE_REJECTED):
        assert measurement_plan(dataclasses.replace(ambiguous, verdict=verdict)) is None
    assert measurement_plan(dataclasses.replace(ambiguous, recommended=None)) is None


def test_a_plan_is_in_volts_where_the_test_was(ambiguous, tmp_path):
    """0.5 V for a newton; what was filled in joins the states of the first test, not others."""
    volts = dataclasses.replace(ambiguous.data, drive=0.5 * ambiguous.data.force)
    plan = measurement_plan(dataclasses.replace(ambiguous, data=volts))
    write_plan(tmp_path / "plan.csv", plan)
    with (tmp_path / "plan.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert "force_n" not in rows[0]
    assert "force_std_n" not in rows[0]
    volts_written = [float(row["drive_v"]) for row in rows]
    np.testing.assert_allclose(volts_written, 0.5 * np.asarray(plan.states.force), rtol=1e-5)
    for row in rows:
        row.update((name, "0.001") for name, text in row.items() if text == "")
    with (tmp_path / "plan.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(ValueError, match=r"must have the column `force_n`.*plan.csv has `drive_v`"):
        read_further_states(tmp_path / "plan.csv", balanced_model(), ambiguous.data)
    joined = read_further_states(tmp_path / "plan.csv", balanced_model(), volts)
    assert joined.n_states == ambiguous.data.n_states + len(rows)
    assert joined.harmonic_order == (2, 3)
    recorded = np.isfinite(np.asarray(joined.harmonics)).all(axis=(1, 2))
    np.testing.assert_array_equal(recorded, np.arange(joined.n_states) >= ambiguous.data.n_states)
