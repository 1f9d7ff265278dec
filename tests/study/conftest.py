"""A linear structure whose members' peaks are known in closed form, and workers in this process."""

from concurrent.futures import Executor, Future

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.study.execution import Workers

OMEGA, SHAPE, PARTICIPATION = 2 * np.pi * 50.0, 2.0, 3.0


class InThisProcess(Executor):
    """Tasks done at once; `before` is called with each and may raise what a dying process would."""

    def __init__(self, before=None):
        self.before, self.done = before, []

    def submit(self, function, *arguments):
        future = Future()
        try:
            if self.before is not None:
                self.before(function, *arguments)
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        self.done.append(function.__name__)
        return future

    @property
    def workers(self):
        """As a study takes them."""
        return Workers(lambda: self, 2, lambda _: None)


def peak_velocity(force, damping):
    """Of a linear mode at resonance: F φ Φᵀb / (2 ζ ω)."""
    return force * SHAPE * PARTICIPATION / (2 * np.asarray(damping) * OMEGA)


@pytest.fixture(scope="session")
def linear_model():
    modes = sj.model.linear_modes([OMEGA], [0.02], [[SHAPE]], [PARTICIPATION])
    return sj.model.structure(modes, name="linear")


@pytest.fixture(scope="session")
def linear_peaks():
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.2 * OMEGA, harmonic_order=1, stability=False)
    return lambda forces=None: sj.study.Peaks(within, forces)


@pytest.fixture
def linear_study(linear_model, linear_peaks):
    return sj.study.Study(
        "damping of a linear mode",
        linear_model,
        linear_peaks([0.5]),
        (sj.study.Uniform("mode_1.damping_ratio", 0.01, 0.03, 7),),
        seed=5,
        members_a_chunk=3,
    )
