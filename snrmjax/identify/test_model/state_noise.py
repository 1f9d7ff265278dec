"""What the states of a test scatter by beyond one size of noise.

Noise of velocities that nobody stated is relative in part (gains, frequency steps) and absolute in
part (the floor of an amplifier): over a wide range of amplitudes one size of either is wrong at
both ends. The natural frequency itself may scatter from state to state, and so does the frequency
that a phase controller sets; this matters most where the mode is driven hardest. Taken for noise of
the phase it would give a modal mass that is too small. The residuals of a fit say how large each
part is.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from snrmjax.identify.test_model.balance import Balance, whitening
from snrmjax.identify.test_model.states import RECORDED, TestStates

_CLEARLY = 20.0  # of −2 ln p, to believe in noise of a kind that nobody stated
_LEAST = 0.01  # of the noise, that is never of another kind: others are in units of it
_OF_FLOOR = 0.05  # of the floor at a typical state, that the relative noise is at least
_START = 0.5  # of the noise, from which a part is looked for


class StateNoise(NamedTuple):
    """Parts of the states' noise beyond the first, zero where the states ask for none."""

    stiffness: float  # 1σ of a relative stiffness that wanders
    floor: float  # 1σ of velocities, m/s, for each of both parts
    noise: float  # that is left for the first part, as `Hyper.noise`

    def of(self, states: TestStates) -> TestStates:
        """The states with these errors too, over the noise that is left."""
        errors = states.errors[:, :RECORDED].copy()
        floor = self.floor / (self.noise * np.abs(states.velocity))
        errors[:, 1:] = np.hypot(errors[:, 1:], floor[:, None])
        if self.stiffness > 0:
            wander = np.full(len(errors), self.stiffness / self.noise)
            errors = np.column_stack([errors, wander])
        return states._replace(errors=errors)


def noise_of_states(
    balance: Balance, unknowns: np.ndarray, errors: np.ndarray, noise: float
) -> StateNoise:
    """The parts that the residuals clearly show, by maximum likelihood.

    A stated noise includes its floor. Where all states have one phase, the frequency scatters.
    Arguments: `balance` of states with errors of one size; `unknowns` and `errors` of the fit, and
    its `noise` over these.
    """
    states, now = balance.states, balance.at(unknowns, errors)
    gap = now.z - now.model - np.sum(now.by_error * errors, axis=1)
    parts_of_gap = np.stack([gap.real, gap.imag], axis=1)
    slopes = now._replace(inputs=RECORDED + 1).by_error
    base = noise * states.errors[:, :RECORDED]
    floor = 1 / np.abs(states.velocity)  # of 1 m/s

    typical = noise * np.median(np.abs(states.velocity))

    def parts(point: np.ndarray, kinds: tuple[bool, bool]) -> np.ndarray:
        found = np.zeros(3)
        found[[True, *kinds]] = np.exp(point)
        found[0] = max(found[0], _LEAST, _OF_FLOOR * found[2] / typical)
        return found

    def criterion(point: np.ndarray, kinds: tuple[bool, bool]) -> float:
        own, wander, second = parts(point, kinds)
        std = np.column_stack([own * base, np.full(len(base), wander)])
        std[:, 1:RECORDED] = np.hypot(std[:, 1:RECORDED], (second * floor)[:, None])
        root, log_det = whitening(slopes, std, balance.weight)
        white = np.einsum("nij,nj->ni", root, parts_of_gap)
        return float(np.sum(white**2)) + log_det

    # Each part as large as the first at a typical state.
    size = np.median(np.abs(noise * now.z) / np.abs(now.stiffness))
    start = np.log(_START * np.array([1.0, size, typical]))
    best = (np.inf, np.zeros(3))
    wander = (True,) if states.of_one_phase else (False, True)
    for kinds in itertools.product(wander, (False, True)[: 2 - states.stated]):
        found = minimize(criterion, start[[True, *kinds]], args=(kinds,), method="Nelder-Mead")
        value = found.fun + _CLEARLY * sum(kinds)
        if value < best[0]:
            best = value, parts(found.x, kinds)
    own, stiffness, second = best[1].tolist()
    return StateNoise(stiffness, second, own * noise)
