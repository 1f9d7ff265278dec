"""Components of the states' noise beyond a single level: noise floor and frequency scatter.

Unstated noise of velocities is partly relative (gains, frequency steps) and partly absolute (the
floor of an amplifier): over a wide range of amplitudes either alone is wrong at both ends. The
natural frequency may also scatter from state to state, as does the frequency that a phase
controller sets; this dominates at large amplitudes. Treated as phase noise it would bias the modal
mass low. The residuals of a fit determine the size of each component.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from snrmjax.identify.test_model.balance import Balance, whitening
from snrmjax.identify.test_model.states import RECORDED, TestStates

_CLEARLY = 20.0  # of −2 ln p, to accept an unstated noise component
_LEAST = 0.01  # lower bound of the relative component, the unit of the others
_OF_FLOOR = 0.05  # its lower bound over the floor at a typical state
_START = 0.5  # of the noise: starting value of each component


class StateNoise(NamedTuple):
    """Noise components beyond the relative one; zero where the data show none."""

    stiffness: float  # 1σ of the stiffness scatter, relative
    floor: float  # 1σ of real and imaginary velocity, m/s
    noise: float  # remaining relative component, as `Hyper.noise`

    def of(self, states: TestStates) -> TestStates:
        """The states with these errors added, in units of the remaining noise."""
        errors = states.errors[:, :RECORDED].copy()
        floor = self.floor / (self.noise * np.abs(states.velocity))
        errors[:, 1:] = np.hypot(errors[:, 1:], floor[:, None])
        if self.stiffness > 0:
            scatter = np.full(len(errors), self.stiffness / self.noise)
            errors = np.column_stack([errors, scatter])
        return states._replace(errors=errors)


def noise_of_states(
    balance: Balance, unknowns: np.ndarray, errors: np.ndarray, noise: float
) -> StateNoise:
    """The components that the residuals clearly show, by maximum likelihood.

    Stated noise includes its floor. Where all states have one phase, frequency scatter is always
    included.
    Arguments: `balance` of states without these components; `unknowns`, `errors` and `noise` of the
    fit.
    """
    states, now = balance.states, balance.at(unknowns, errors)
    residual = now.z - now.model - np.sum(now.by_error * errors, axis=1)
    residual_parts = np.stack([residual.real, residual.imag], axis=1)
    slopes = now._replace(inputs=RECORDED + 1).by_error
    base = noise * states.errors[:, :RECORDED]
    floor = 1 / np.abs(states.velocity)  # of 1 m/s

    std = np.empty((len(base), RECORDED + 1))
    typical = noise * np.median(np.abs(states.velocity))

    def parts(point: np.ndarray, kinds: tuple[bool, bool]) -> np.ndarray:
        stds = np.zeros(3)
        stds[[True, *kinds]] = np.exp(point)
        stds[0] = max(stds[0], _LEAST, _OF_FLOOR * stds[2] / typical)
        return stds

    def criterion(point: np.ndarray, kinds: tuple[bool, bool]) -> float:
        own, scatter, second = parts(point, kinds)
        std[:, :RECORDED], std[:, RECORDED] = own * base, scatter
        std[:, 1:RECORDED] = np.hypot(std[:, 1:RECORDED], (second * floor)[:, None])
        root, log_det = whitening(slopes, std, balance.weight)
        white = np.einsum("nij,nj->ni", root, residual_parts)
        return float(np.sum(white**2)) + log_det

    # Start: each component as large as the relative one at a typical state.
    stiffness_std = np.median(np.abs(noise * now.z) / np.abs(now.stiffness))
    start = np.log(_START * np.array([1.0, stiffness_std, typical]))
    best = (np.inf, np.zeros(3))
    scatter = (True,) if states.of_one_phase else (False, True)
    for kinds in itertools.product(scatter, (False, True)[: 2 - states.stated]):
        minimum = minimize(criterion, start[[True, *kinds]], args=(kinds,), method="Nelder-Mead")
        value = minimum.fun + _CLEARLY * sum(kinds)
        if value < best[0]:
            best = value, parts(minimum.x, kinds)
    own, stiffness, second = best[1].tolist()
    return StateNoise(stiffness, second, own * noise)
