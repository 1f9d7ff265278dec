"""Misfits that no structure has: rows in units of noise, of states in levels."""

from types import SimpleNamespace

import numpy as np

from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import NoiseModel, shared_covariance

LEVELS, PER_LEVEL = 4, 15
N_STATES = LEVELS * PER_LEVEL
N_ROWS = 2 * N_STATES
LEVEL = np.repeat(np.arange(LEVELS), PER_LEVEL)
ANGLE = np.tile(np.linspace(-1.0, 1.0, PER_LEVEL), LEVELS)


def noise_of(whiten, shared=None):
    """The noise of states of which every column is known, with errors that rows share."""
    known = np.ones(whiten.shape[:2], dtype=bool)
    shared = np.zeros((known.sum(), 0)) if shared is None else shared
    of_no_level = np.full(shared.shape[1], -1)
    return NoiseModel(whiten, known, shared_covariance(shared), of_no_level, *np.nonzero(known))


def misfit_of(order=None, shared=None, phase_unknown=False):
    """Evidence of states in a given order, with real and imaginary part of the force each."""
    order = np.arange(N_STATES) if order is None else order
    velocity = (1.5**LEVEL * np.cos(ANGLE) * np.exp(1j * ANGLE))[order]
    chosen = SimpleNamespace(
        states=SimpleNamespace(level=LEVEL[order], velocity=velocity[:, None]),
        rows=np.arange(N_STATES),
        n_levels=LEVELS,
        noise_stated=True,
        orders=(),
        sensors=(0,),
        phase_unknown=np.full((N_STATES, 1), phase_unknown),
    )
    return SimpleNamespace(
        noise=noise_of(np.tile(np.eye(2), (N_STATES, 1, 1)), shared),
        predictions=SimpleNamespace(
            chosen=chosen,
            level_error_std=(0.0,) * 4,
            unstated_levels=(False,) * 4,
            error_scale=1.0,
        ),
        level_numbers=np.arange(1, LEVELS + 1),
        by_linear=np.tile(np.eye(2), (N_STATES, 1)),
        n_rows=N_ROWS,
    )


def fit_to(rows, slopes=None, kinds=()):
    """A fit that leaves these rows."""
    slopes = np.zeros((len(rows), 0)) if slopes is None else slopes
    values = np.zeros(slopes.shape[1])
    bounds = np.full(slopes.shape[1], np.inf)
    square = float(np.sum(rows**2))
    return EffectFit(kinds, (), values, square, rows, slopes, -bounds, bounds)


def noise(seed=0):
    """Independent rows of unit variance."""
    return np.random.default_rng(seed).normal(size=N_ROWS)
