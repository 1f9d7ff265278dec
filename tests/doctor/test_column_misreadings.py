"""Caveats of an identification with misread columns, on the exact responses of a mode."""

from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import equinox as eqx
import numpy as np
import pytest
from truths.one_mode import OMEGA, SHAPE, ZETA, model, noisy, states, table

import snrmjax as sj
from snrmjax.doctor import column_misreadings
from snrmjax.doctor.column_misreadings import caveat, linear_damping_note, with_caveat
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.pipelines.identify import identify_test

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FEW = slice(None, None, 5)  # nine states, three per level, too few to detect wrong phases


def few(change=lambda w, f, v: (f, v), seed=0):
    level, w, f, v = (column[FEW] for column in states())
    return table(level, w, *change(w, f, noisy(v, seed)))


class Points(NamedTuple):
    """Result of `identify_points`, by the same balance in one line: Ω² + Re iΩF/(cV), Im /Ω."""

    level: np.ndarray
    amplitude: np.ndarray
    natural_frequency: np.ndarray
    damping_ratio: np.ndarray
    usable: np.ndarray


def caveats(data, structure):
    w, v = np.asarray(data.frequency), np.asarray(data.velocity)[:, 0]
    balance = 1j * w * np.asarray(data.force) * float(structure.modes.mode_shape[0, 0]) ** 2 / v
    natural = np.sqrt(np.abs(w**2 + balance.real))
    ratio = balance.imag / w / (2 * natural)
    level, every = np.asarray(data.level), np.ones(len(w), dtype=bool)
    return caveat(data, structure, Points(level, np.abs(v) / w, natural, ratio, every))


@pytest.mark.parametrize(
    ("change", "kind", "named"),
    [
        (lambda w, f, v: (f, v / 9.80665), "mixed_units", ("response", "g", "m/s²")),
        (lambda w, f, v: (f, 1e3 * v), "mixed_units", ("response", "mm", "m")),
        (lambda w, f, v: (f / 4.4482216, v), "mixed_units", ("force", "pounds", "N")),
        (lambda w, f, v: (f, v.conj()), "misread", "conjugated"),
        (lambda w, f, v: (f, 1j * w * v), "misread", "acceleration"),
        (lambda w, f, v: (f, v / np.sqrt(2)), "rms", "response"),
    ],
)
def test_a_wrong_unit_or_phase_sign_is_named_with_advice(change, kind, named):
    (note,) = caveats(few(change), model())
    evidence = note["evidence"]
    assert (note.kind, evidence.kind) == ("column_misread", kind)
    assert named in (evidence.get("reading"), evidence.get("column"), *evidence.get("units", ()))
    assert note["importable"]
    assert str(note["advice"]).rstrip(".") in str(note)


@pytest.mark.parametrize("factor", [9.80665, 1e-3, 1 / 4.4482216])
def test_the_factor_is_that_of_the_mixed_units(factor):
    (note,) = caveats(few(lambda w, f, v: (f, v / factor)), model())
    evidence = note["evidence"]
    # 4σ: one in 16000 by chance
    assert abs(evidence["ratio"] - factor) < 4 * evidence["ratio_std"] < 0.04 * factor


def test_good_states_have_no_caveat():
    for seed in range(3):
        assert caveats(few(seed=seed), model()) == ()


def test_wrong_phases_are_not_reported_twice():
    level, w, f, v = states()
    data = table(level, w, f, noisy(v).conj())
    assert wrong_phases(data, model())[0]["conjugated"]
    assert caveat(data, model()) == ()


def test_another_assembly_is_reported():
    """1 % of the frequency is a linear test's error; 20 % and five times the damping are not."""

    def other(frequency, damping):
        modes = sj.model.linear_modes(
            [frequency * OMEGA], [damping * ZETA], [[SHAPE]], [SHAPE], sensors=("tip",)
        )
        return caveats(few(), sj.model.structure(modes))

    assert other(1.01, 1.2) == ()
    (note,) = other(1.2, 0.2)
    assert note["quantities"] == ("natural frequency", "damping")
    assert note["linear"] == pytest.approx((1.2 * OMEGA / (2 * np.pi), 0.2 * ZETA))


def test_few_states_and_voltages_are_left_alone():
    data = few(lambda w, f, v: (f, 1e3 * v))
    assert caveat(data.select(np.arange(7)), model()) == ()
    level, w, f, v = (column[FEW] for column in states())
    driven = sj.measure.steady_states(level, w, np.full(9, np.nan), v, drive=f, sensors=("tip",))
    assert caveat(driven, model()) == ()


def test_an_error_of_identification_has_its_cause():
    data = few(lambda w, f, v: (f, v / (1j * w)))
    message = str(with_caveat(ValueError("no points."), data, model()))
    assert message.startswith("no points. the responses appear to be displacements")
    assert str(with_caveat(ValueError("no points."), few(), model())) == "no points."


def test_damping_at_rest_is_compared_with_the_linear_tests(monkeypatch):
    """2 % and 2.2 %, each ± 0.05 %: 0.2/√(0.05² + 0.05²) = 2.8 standard deviations apart."""

    def note(fitted, own):
        at_rest = SimpleNamespace(damping_ratio=[fitted], damping_ratio_std=[5e-4])
        monkeypatch.setattr(column_misreadings, "fitted_values", lambda *_, **__: at_rest)
        linear = eqx.tree_at(lambda m: m.modes.damping_ratio_std, model(), np.array([own]))
        return linear_damping_note(None, linear)

    (fact,) = note(0.022, 5e-4)
    assert fact["apart"] == pytest.approx(0.002 / np.hypot(5e-4, 5e-4))
    assert note(0.021, 5e-4) == ()
    assert note(0.022, 0.0) == note(0.022, np.nan) == note(np.nan, 5e-4) == ()


@pytest.mark.long
def test_an_identification_without_points_reports_the_cause():
    data = few(lambda w, f, v: (f, v / (1j * w)))
    with pytest.raises(ValueError, match=r"no real natural frequency.*as displacements"):
        identify_test(data, model())


@pytest.mark.long
def test_the_note_comes_first():
    data = few(lambda w, f, v: (f, v / 9.80665))
    result = identify_test(data, model())
    assert result.notes[0] == caveats(data, model())[0]


@pytest.mark.long
@pytest.mark.parametrize("name", ["response_controlled", "force_controlled"])
def test_measured_beams_are_silent(name):
    folder = DATA / "brake_reuss_beam"
    if not folder.exists():
        pytest.skip("the measured data are not in ../shared/data")
    structure = sj.read_model(folder / "model.toml")
    data = sj.read_steady_states(folder / f"{name}.csv", structure)
    assert caveats(data, structure) == ()
