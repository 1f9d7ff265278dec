"""Strongly nonlinear modes are no errors of import: exact balances with a cubic spring."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.doctor.column_misreadings import caveat
from snrmjax.measure import steady_states

OMEGA, ZETA, SHAPE = 2 * np.pi * 137.0, 6e-4, 3.0
APART = np.array([1.0, 0.992, 1.006, 0.997])  # of natural frequencies, as temperature makes them


def model():
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[SHAPE]], [SHAPE], sensors=("tip",))
    return sj.model.structure(modes)


def upsweep(shift, apart=1.0, noise=0.003, states=30, both=False, seed=0):
    """Four levels of one force each, up to phase resonance; ω̃² = ω²(1 + ((1 + shift)² − 1)a²).

    The roots Ω² of (K − Ω²)² + (2ζωΩ)² = (F/a)² are exact for every amplitude.
    """
    rows = []
    for k, top in enumerate((0.4, 0.6, 0.8, 1.0)):
        own = OMEGA * np.broadcast_to(apart, 4)[k]
        rate = 2 * ZETA * own
        a = top * np.sin(np.linspace(0.15, np.pi / 2, states))
        stiffness = own**2 * (1 + ((1 + shift) ** 2 - 1) * a**2)
        force = top * rate * np.sqrt(stiffness[-1])
        half = stiffness - rate**2 / 2
        side = np.where(both & (np.arange(states) % 2 == 0), 1.0, -1.0)
        w = np.sqrt(half + side * np.sqrt(np.maximum(half**2 - stiffness**2 + (force / a) ** 2, 0)))
        v = 1j * w * force / (stiffness - w**2 + 1j * rate * w)
        rows.append(np.stack([np.full(states, k + 1), w, np.full(states, force), v]))
    level, w, force, v = np.concatenate(rows, axis=1)
    rng = np.random.default_rng(seed)
    v = SHAPE * v * np.exp(noise * (rng.normal(size=len(v)) + 1j * rng.normal(size=len(v))))
    return level.real.astype(int), w.real, force.real / SHAPE, v


def table(level, w, force, v):
    return steady_states(level, w, force, v, sensors=("tip",))


@pytest.mark.parametrize("shift", [0.02, pytest.param(0.15, marks=pytest.mark.long), 0.35])
@pytest.mark.parametrize("apart", [1.0, APART])
def test_hardening_by_tens_and_hundreds_of_bandwidths_is_no_error(shift, apart):
    """A bandwidth is 0.12 %: resonances move by 16 to 290 of them, levels by up to 7."""
    data = table(*upsweep(shift, apart))
    assert sj.doctor.check_test(data, model()).kinds == ()
    assert caveat(data, model()) == ()


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        pytest.param(lambda w, f, v: (f, v.conj()), "conjugated_response", marks=pytest.mark.long),
        (lambda w, f, v: (f, 1j * w * v), "acceleration_as_velocity"),
        (lambda w, f, v: (f, v / (1j * w)), "displacement_as_velocity"),
        pytest.param(lambda w, f, v: (f, -v), "shape_not_mass_normalised", marks=pytest.mark.long),
    ],
)
def test_errors_of_import_are_still_reported(change, kind):
    level, w, f, v = upsweep(0.05, APART, both=True)
    findings = sj.doctor.check_test(table(level, w, *change(w, f, v)), model()).findings
    assert findings[0].kind == kind


def test_a_sensor_against_the_force_is_no_error_if_the_model_has_it():
    level, w, f, v = upsweep(0.05)
    modes = sj.model.linear_modes([OMEGA], [ZETA], [[-SHAPE]], [SHAPE], sensors=("tip",))
    checkup = sj.doctor.check_test(table(level, w, f, -v), sj.model.structure(modes))
    assert checkup.kinds == ()
