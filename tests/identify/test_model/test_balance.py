"""The force balance: derivatives against finite differences, and errors against known ones."""

import numpy as np
import pytest

from snrmjax.identify.test_model import states as measured
from snrmjax.identify.test_model.balance import Balance
from snrmjax.identify.test_model.curve_basis import CurveBasis
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.hyper import ALONG, OFFSET, PHASE, TREND, layout_of

LEVELS, OMEGA, CONSTANT = 3, 500.0, 6.0


def balance(*, force_is_free=False, discrepancy=True, others=0):
    """Random states near a mode, which follow no law, and unknowns of plausible magnitude."""
    rng = np.random.default_rng(0)
    level = np.repeat(np.arange(LEVELS), 7)
    n = len(level)
    omega = OMEGA * (1 + 0.02 * rng.normal(size=n))
    velocity = (0.2 + 0.3 * level) * np.exp(0.1 * rng.normal(size=n) + 1j * rng.uniform(-1, 1, n))
    # With uncertain other modes, a scatter of the stiffness too.
    std = [0.001, 0.01, 0.01, 0.003] if others else [0.001, 0.01, 0.01]
    of_others = 0.01 * rng.normal(size=(2, n, others)).T @ [1, 1j] if others else None
    states = measured.TestStates(
        *(level, omega, 1.0 + rng.uniform(size=n), velocity, np.tile(std, (n, 1))),
        *(True, CONSTANT, (0.0, 0.01, 0.0, 0.0), 0.05, force_is_free, 0.1, 0.1),
        *(np.linspace(-0.5, 0.5, n), 0.1, None if of_others is None else of_others.T),
    )
    basis = CurveBasis.of(states.amplitude, 8)
    terms = CurveTerms(basis, 1e4), CurveTerms(basis, 10.0)
    layout = layout_of(terms, LEVELS, discrepancy, OMEGA**2, others)
    basis_functions = np.zeros((n, 2 * ALONG * discrepancy), dtype=complex)
    own = Balance(states, terms, layout, np.ones(n), basis_functions)
    unknowns = np.zeros(layout.others.stop)
    unknowns[layout.others] = 0.5
    unknowns[layout.stiffness] = 0.1 * rng.normal(size=basis.n_functions)
    unknowns[layout.damping] = 1 + 0.1 * rng.normal(size=basis.n_functions)
    unknowns[[0, PHASE, OFFSET, TREND]] = 0.02, 0.03, 0.0, 0.05
    unknowns[layout.levels] = 0.05 * rng.normal(size=(LEVELS, 4))
    errors = 0.01 * rng.normal(size=(n, len(std)))
    return own.with_discrepancy(unknowns, errors), unknowns, errors


def balanced(own, unknowns, errors):
    """Forces and phases with which the states, corrected for these errors, lie on the curves."""
    now = own.at(unknowns, errors)
    ratio, states = now.model / now.z, own.states
    rotation = np.exp(-1j * np.angle(ratio))
    states = states._replace(
        force=states.force * np.abs(ratio),
        velocity=states.velocity * rotation,
        other_modes=None if states.other_modes is None else states.other_modes * rotation[:, None],
    )
    own = own._replace(states=states)
    now = own.at(unknowns, errors)
    np.testing.assert_allclose(now.z, now.model, rtol=1e-10)
    return own


def residual(own, unknowns, errors):
    now = own.at(unknowns, errors)
    return now.z - now.model


@pytest.mark.parametrize("force_is_free", [False, True])
@pytest.mark.parametrize("others", [0, 2])
def test_slopes_by_unknowns_are_differences(force_is_free, others):
    own, unknowns, errors = balance(force_is_free=force_is_free, others=others)
    own = balanced(own, unknowns, errors)
    linear = own.linearised(unknowns, errors, apart=False)
    rows = linear.design.reshape(-1, 2, len(unknowns))
    # The same rows by finite differences, whitened.
    for k in np.flatnonzero(np.any(rows != 0, axis=(0, 1))):
        step = np.zeros(len(unknowns))
        step[k] = 1e-6
        ends = [residual(own, unknowns + sign * step, errors) for sign in (1, -1)]
        slope = -(ends[0] - ends[1]) / 2e-6
        scale = np.linalg.norm(rows[:, :, k])
        white = whitened(own, unknowns, errors, slope)
        np.testing.assert_allclose(rows[:, :, k], white, atol=1e-5 * scale)


def whitened(own, unknowns, errors, values):
    """Through the inverse root of J C Jᵀ, with J by differences of the balance."""
    std, out = own.states.errors, np.zeros((len(values), 2))
    jacobian = np.zeros((len(values), 2, std.shape[1]))
    for k in range(std.shape[1]):
        step = np.zeros(std.shape[1])
        step[k] = 1e-7
        slope = (
            residual(own, unknowns, errors + step) - residual(own, unknowns, errors - step)
        ) / 2e-7
        jacobian[:, :, k] = np.stack([slope.real, slope.imag], axis=1)
    for n, (one, error) in enumerate(zip(jacobian, std, strict=True)):
        root = np.linalg.cholesky(one @ np.diag(error**2) @ one.T)
        out[n] = np.linalg.solve(root, [values[n].real, values[n].imag])
    return out


def test_nearest_errors_satisfy_the_balance_and_are_minimal():
    own, unknowns, errors = balance()
    own = balanced(own, unknowns, 0 * errors)
    velocity = own.states.velocity * np.exp(0.01 * np.sin(np.arange(21)))
    erring = own._replace(states=own.states._replace(velocity=velocity))
    found = erring.nearest_errors(unknowns, 0 * errors)
    remaining = residual(erring, unknowns, found)
    assert np.max(np.abs(remaining) / np.abs(erring.at(unknowns, found).z)) < 1e-8
    # Not larger, in 1σ, than the errors that were added.
    put = np.zeros_like(found)
    put[:, 1] = -0.01 * np.sin(np.arange(21))
    assert np.all(
        np.sum((found / own.states.errors) ** 2, axis=1)
        <= np.sum((put / own.states.errors) ** 2, axis=1) * (1 + 1e-3) + 1e-12
    )


def test_errors_common_to_all_levels_are_no_level_errors():
    own, unknowns, errors = balance(discrepancy=False)
    linear = own.linearised(unknowns, errors)
    for kind, std in enumerate(own.states.level_std):
        together = linear.design[:, own.layout.levels[:, kind]].sum(axis=1)
        scale = np.abs(linear.design[:, own.layout.levels[:, kind]]).max()
        assert (np.abs(together).max() > 0.1 * scale) == (std > 0)  # a stated one may be shared


def test_a_discrepancy_vanishes_at_phase_resonance():
    own, unknowns, errors = balance()
    states = own.states._replace(velocity=np.abs(own.states.velocity).astype(complex))
    found = own._replace(states=states).with_discrepancy(unknowns, errors)
    in_quadrature = found.discrepancy[:, ALONG:]
    np.testing.assert_allclose(in_quadrature, 0.0, atol=1e-12)
