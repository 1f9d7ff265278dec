"""Paths through limit points against a published load."""

import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.static_path import PathStatus, static_path


@pytest.mark.long
def test_a_deep_arch_carries_the_published_load_and_then_less():
    # As in test_statics: DaDeppo & Schmidt (1975), 8.97 EI/R².
    half, width, thickness = np.deg2rad(107.5), 1.0, 1e-3
    beam = Beam(
        *(2 * np.sin(half), width, thickness),
        rise=1 - np.cos(half),
        young=12 / (width * thickness**3),
        density=1.0,
        right="pinned",
    )
    load = jnp.zeros(beam.n_dof).at[3 * 20 + 1].set(-1.0)
    path = static_path(beam, load, 0.1, points=90)
    assert path.status is PathStatus.COMPLETE
    top = int(np.argmax(path.stable[1:] < path.stable[:-1]))
    assert abs(path.load_fraction[top : top + 2].max() - 8.97) < 0.02
    assert path.load_fraction[top + 3] < path.load_fraction[top + 1]
    # Work of the load is the strain energy: trapezoidal rule over the path.
    crown = -path.displacement[:, 3 * 20 + 1]
    work = np.trapezoid(path.load_fraction, crown)
    assert abs(work / path.energy[-1] - 1) < 2e-3


def test_a_step_of_zero_is_refused():
    beam = Beam(1.0, 0.02, 0.002, young=2e11, density=7800.0, elements=2)
    with pytest.raises(ValueError, match="step"):
        static_path(beam, jnp.ones(beam.n_dof), 0.0)
