"""Motions with a hard stop and twice the harmonics of their balance, by sums over one period."""

import numpy as np

import snrmjax as sj
from snrmjax.numerics.blocks import stacked
from snrmjax.simulate.balance.harmonic_balance import harmonic_balance
from snrmjax.simulate.continuation.left_out_harmonics import completed_motions
from snrmjax.simulate.continuation.stability import Stability, many_multipliers, stability_of

OMEGA, RATIO, FORCE, STOP, GAP = 100.0, 0.01, 3.0, 2e5, 8e-3  # of a unit mass
HARMONICS, SAMPLES, FINE = 5, 512, 16384


def motions():
    """The balance, and scaled points of its curve past the stop's onset."""
    modes = sj.model.linear_modes([OMEGA], [RATIO], [[1.0]], [1.0])
    stop = sj.model.make_effect("one_sided_stop", {"stiffness": STOP, "gap": GAP})
    model = sj.model.structure(modes, effects=(stop,))
    settings = {"harmonic_order": HARMONICS, "n_samples": SAMPLES}
    (curve,) = sj.forced_response(
        model, FORCE, 0.9 * OMEGA, 1.6 * OMEGA, **settings, stability=False
    )
    balance = harmonic_balance(model, FORCE, 0.01, **settings)
    scaled = curve.coefficients.reshape(len(curve.frequency), -1) / 0.01
    points = np.concatenate([scaled, curve.frequency[:, None] / OMEGA], axis=1)
    return stacked([balance]), points


def test_a_hard_stop_has_motions_with_twice_the_harmonics_or_reports_that_it_has_none():
    balances, points = motions()
    assert len(points) > 20
    nowhere = 1e3 * np.random.default_rng(0).normal(size=(1, points.shape[1]))
    every = np.concatenate([points, nowhere])
    owner = np.zeros(len(every), dtype=int)
    coefficients, frequency = completed_motions(balances, owner, every)
    assert np.isfinite(frequency[:-1]).all()
    order = np.arange(1, 2 * HARMONICS + 1)
    turn = np.outer(2 * np.pi * np.arange(FINE) / FINE, order)
    c, s = np.cos(turn), np.sin(turn)
    for own, omega in zip(coefficients[:-1, :, 0], frequency[:-1], strict=True):
        cos, sin = own[1::2], own[2::2]
        q = own[0] + c @ cos + s @ sin
        v = omega * (c @ (order * sin) - s @ (order * cos))
        a = -(omega**2) * (c @ (order**2 * cos) + s @ (order**2 * sin))
        left = a + 2 * RATIO * OMEGA * v + OMEGA**2 * q + STOP * np.maximum(q - GAP, 0.0)
        left -= FORCE * c[:, 0]
        kept = np.fft.rfft(left)[: 2 * HARMONICS + 1] * 2 / FINE
        # Sampling error at the stop's onset; without further harmonics the residual is 1e3 N.
        assert np.abs(kept).max() < 4e-4 * FORCE
    known = stability_of(many_multipliers(balances, owner, every))
    assert (known[:-1] != Stability.NOT_COMPUTED).all()
    assert known[-1] == Stability.NOT_COMPUTED
