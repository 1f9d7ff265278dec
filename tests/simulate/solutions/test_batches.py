"""Batches of responses: each member as computed alone, failures isolated, no recompilation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.numerics.blocks import by_blocks, over_cores, padded, stacked, taken
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.solutions.forced_response import (
    ResponseSettings,
    forced_response,
    forced_response_batch,
)

RANGE = (1.0, 3.5)
SETTINGS = ResponseSettings(harmonic_order=3)


def one_mode(quartic=0.3, ratio=0.02):
    modes = linear_modes([2.0], [ratio], [[1.0]], [1.5])
    return structure(modes, polynomial_potential({"111": 0.05, "1111": quartic}, 1))


def members(count):
    """Models and forces, no two of them alike."""
    fraction = np.linspace(0.0, 1.0, count)
    return [one_mode(0.1 + 0.3 * s, 0.02 + 0.01 * s) for s in fraction], 0.05 + 0.1 * fraction[::-1]


@pytest.fixture(scope="module")
def batch():
    models, forces = members(11)  # more than the eight that one program follows
    return forced_response_batch(models, forces, *RANGE, settings=SETTINGS)


def assert_same_curve(one, other):
    assert one.status == other.status
    assert one.event == other.event
    assert one.n_solves == other.n_solves
    # The same steps; a block of eight and a single curve are two programs, with different rounding.
    np.testing.assert_allclose(one.frequency, other.frequency, rtol=1e-9)
    scale = np.abs(other.coefficients).max()
    np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=0, atol=1e-8 * scale)
    np.testing.assert_array_equal(one.stability, other.stability)
    np.testing.assert_allclose(one.multipliers, other.multipliers, rtol=0, atol=1e-6)


def test_every_member_is_the_response_alone(batch):
    models, forces = members(11)
    assert len(batch.curves) == 11
    for k in (0, 4, 10):
        alone = forced_response(models[k], [forces[k]], *RANGE, harmonic_order=3)
        assert len(alone) == len(batch.curves[k]) == 1
        assert_same_curve(batch.curves[k][0], alone[0])


def test_numbers_of_a_batch_are_those_of_its_curves(batch):
    assert batch.status.tolist() == [CurveStatus.UPPER_END] * 11
    for k, (curve,) in enumerate(batch.curves):
        assert batch.n_points[k] == len(curve.frequency)
        assert batch.n_folds[k] == curve.at_events("fold").size
        (peak,) = curve.at_events("peak")
        assert batch.peak_frequency[k] == curve.frequency[peak]
        assert batch.peak_velocity[k] == np.abs(curve.velocity[peak, 1, 0])
        (resonance,) = curve.at_events("phase_resonance")
        assert batch.resonance_frequency[k] == curve.frequency[resonance]
        assert batch.resonance_velocity[k] == np.abs(curve.velocity[resonance, 1, 0])
    assert np.ptp(batch.peak_frequency) > 0.1
    assert {0, 2} == set(batch.n_folds.tolist())


def test_members_that_fail_leave_the_others_untouched(batch):
    models, forces = members(11)
    models, forces = list(models), forces.copy()
    broken = eqx.tree_at(lambda m: m.modes.damping_ratio, models[1], jnp.array([jnp.nan]))
    models[1] = broken
    forces[[2, 3, 4, 5]] = 0.0, -1.0, np.nan, np.inf
    forces[6] = 1e30  # Newton's method fails
    mixed = forced_response_batch(models, forces, *RANGE, settings=SETTINGS)
    assert mixed.status[1:6].tolist() == [CurveStatus.INVALID] * 5
    assert mixed.status[6] == CurveStatus.NO_START
    for k in range(1, 7):
        assert mixed.n_points[k] == mixed.n_folds[k] == 0
        for values in (
            *(mixed.peak_frequency, mixed.peak_velocity),
            *(mixed.resonance_frequency, mixed.resonance_velocity),
        ):
            assert np.isnan(values[k])
        for nothing in mixed.curves[k]:
            assert nothing.coefficients.shape == (0, 7, 1)
            assert nothing.velocity.shape == (0, 4, 1)
    for k in (0, 7, 8, 9, 10):
        assert mixed.status[k] == CurveStatus.UPPER_END
        assert_same_curve(mixed.curves[k][0], batch.curves[k][0])


def test_a_batch_of_failures_alone_and_an_empty_one():
    failed = forced_response_batch(one_mode(), [0.0, np.nan], *RANGE, settings=SETTINGS)
    assert failed.status.tolist() == [CurveStatus.INVALID] * 2
    empty = forced_response_batch(one_mode(), [], *RANGE, settings=SETTINGS)
    assert len(empty.status) == len(empty.peak_frequency) == len(empty.curves) == 0


def test_other_numbers_and_more_members_compile_nothing(batch, compilations):
    models, forces = members(19)
    assert len(compilations) == 0
    more = forced_response_batch(models, 1.1 * forces, 1.05, 3.4, settings=SETTINGS)
    assert len(compilations) == 0
    assert more.status.tolist() == [CurveStatus.UPPER_END] * 19
    assert len(batch.status) == 11
    jax.jit(lambda x: jnp.sin(x) + 0.123)(1.0).block_until_ready()
    assert len(compilations) > 0  # the counter works


def test_chunks_give_the_same_and_report_their_progress(batch):
    models, forces = members(11)
    reported = []
    chunked = forced_response_batch(
        *(models, forces, *RANGE),
        settings=SETTINGS,
        chunk=4,
        keep_curves=False,
        progress=lambda done, of: reported.append((done, of)),
    )
    assert reported == [(4, 11), (8, 11), (11, 11)]
    assert chunked.curves == ()
    np.testing.assert_array_equal(chunked.status, batch.status)
    np.testing.assert_array_equal(chunked.n_points, batch.n_points)
    np.testing.assert_allclose(chunked.peak_velocity, batch.peak_velocity, rtol=1e-9)


def test_members_must_fit_together():
    with pytest.raises(ValueError, match="must be as many, or one, but are 2 and 3"):
        forced_response_batch([one_mode(), one_mode()], [0.1, 0.2, 0.3], *RANGE)
    drag = make_effect("quadratic_damping", {"coefficient": 0.1})
    other = structure(one_mode().modes, one_mode().potential, effects=(drag,))
    with pytest.raises(ValueError, match="but number 1 differs from the first"):
        forced_response_batch([one_mode(), other], 0.1, *RANGE)
    with pytest.raises(ValueError, match="`from_frequency` must be positive and below"):
        forced_response_batch(one_mode(), 0.1, 3.0, 1.0)


# ------------------------------------------------------------------------------------- blocks


def test_rows_are_padded_and_worked_on_in_blocks():
    rows = np.arange(10.0).reshape(5, 2)
    more = padded(rows, 4)
    assert more.shape == (8, 2)
    np.testing.assert_array_equal(more[:5], rows)
    np.testing.assert_array_equal(more[5:], rows[[4, 4, 4]])
    assert padded(rows, 16).shape == (16, 2)
    shapes = []

    def double(part):
        shapes.append(part.shape)
        return 2 * part, part.sum(axis=1)

    twice, total = by_blocks(double, 3, rows)
    assert shapes == [(3, 2), (3, 2)]
    np.testing.assert_array_equal(twice, 2 * rows)
    np.testing.assert_array_equal(total, rows.sum(axis=1))


def test_models_are_stacked_and_taken_again():
    models = [one_mode(0.1), one_mode(0.2), one_mode(0.3)]
    together = stacked(models)
    np.testing.assert_array_equal(together.potential.coefficient[:, 1], [0.1, 0.2, 0.3])
    again = taken(together, 1)
    assert eqx.tree_equal(
        jax.tree.map(np.asarray, again), jax.tree.map(np.asarray, models[1]), rtol=0, atol=0
    )


def test_jobs_keep_their_order_and_raise_their_errors():
    reported = []
    found = over_cores(lambda k: k**2, range(7), progress=lambda *row: reported.append(row))
    assert found == [k**2 for k in range(7)]
    assert reported == [(k, 7) for k in range(1, 8)]

    def job(k):
        if k == 3:
            raise ValueError("job 3")
        return k

    with pytest.raises(ValueError, match="job 3"):
        over_cores(job, range(5))
