"""What the states of a test scatter by beyond one size of noise.

Noise of velocities that nobody stated is relative in part (gains, frequency steps) and absolute in
part (the floor of an amplifier): over a wide range of amplitudes one size of either is wrong at
both ends. A natural frequency that wanders from state to state moves the balance most where the
mode is driven hardest. The residuals of a fit say how large each is.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from snrmjax.identify.test_model.posterior import TestPosterior
from snrmjax.identify.test_model.states import TestStates

_CLEARLY = 20.0  # of −2 ln p, to believe in noise of a kind that nobody stated
_LEAST = 0.05  # of the noise, that is never of another kind: others are in units of it
_START = 0.5  # of the noise, from which a part is looked for


class StateNoise(NamedTuple):
    """Parts of the states' noise beyond the first, zero where the residuals ask for none."""

    stiffness: float  # 1σ of a relative stiffness that wanders
    floor: float  # 1σ of velocities, m/s, for each of both parts
    noise: float  # that is left for the first part, as `Hyper.noise`

    def of(self, states: TestStates) -> TestStates:
        """The states with these errors too, over the noise that is left."""
        errors = states.errors[:, :3].copy()
        wander = states.errors[:, 3:].sum(axis=1)
        floor = self.floor / (self.noise * np.abs(states.velocity))
        errors[:, 1:3] = np.hypot(errors[:, 1:3], floor[:, None])
        wander = np.hypot(wander, self.stiffness / self.noise)
        if np.any(wander > 0):
            errors = np.column_stack([errors, wander])
        return states._replace(errors=errors)


def noise_of_states(posterior: TestPosterior) -> StateNoise:
    """The parts that the residuals clearly ask for, by the largest likelihood.

    A stated noise has its floor where it was stated.
    """
    states, unit = posterior.states, posterior.hyper.noise
    arm = posterior.arms_of_stiffness / unit
    length = np.sum(arm**2, axis=1)
    along = np.sum(arm * posterior.residuals, axis=1) ** 2
    size = np.sum(posterior.residuals**2, axis=1)
    # A floor of 1 m/s, over the first part.
    floor = (unit * states.errors[:, 1] * np.abs(states.velocity)) ** -2.0

    def parts(point: np.ndarray, kinds: tuple[bool, bool]) -> np.ndarray:
        found = np.zeros(3)
        found[[True, *kinds]] = np.exp(2 * point)
        found[0] = max(found[0], _LEAST**2)
        return found

    def criterion(point: np.ndarray, kinds: tuple[bool, bool]) -> float:
        noise, extra, second = parts(point, kinds)
        own = noise + second * floor
        inner = own + extra * length
        squares = (size - along * extra / inner) / own
        return float(np.sum(squares + np.log(own) + np.log(inner)))

    start = np.log(_START / np.sqrt([1.0, np.median(length), np.median(floor)]))
    best = (np.inf, np.zeros(3))
    for kinds in itertools.product((False, True), (False, True)[: 2 - states.stated]):
        found = minimize(criterion, start[[True, *kinds]], args=(kinds,), method="Nelder-Mead")
        value = found.fun + _CLEARLY * sum(kinds)
        if value < best[0]:
            best = value, parts(found.x, kinds)
    noise, stiffness, second = np.sqrt(best[1]).tolist()
    return StateNoise(stiffness, second, noise * unit)
