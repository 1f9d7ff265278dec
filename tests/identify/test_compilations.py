"""An identification of other numbers, levels, knots and states compiles nothing anew."""

import numpy as np
from truths.exact_states import exact, modes

import snrmjax as sj


def states(seed, levels):
    rng = np.random.default_rng(seed)
    _, omega, force, velocity = exact()
    own = rng.normal(size=len(omega)) + 1j * rng.normal(size=len(omega))
    level = np.arange(len(omega)) * levels // len(omega)
    return sj.measure.steady_states(level, omega, force, velocity * np.exp(0.01 * own))


def test_points_and_curves_of_as_many_states(compilations):
    found = sj.identify_backbone(states(0, 5), modes())
    found.backbone.values(np.linspace(*(float(x) for x in ends(found)), 50))
    # Points are three programs; the fit is the host's but for what its modes and unknowns are put
    # together by, an operation each.
    assert len(compilations) <= 20
    del compilations[:]
    for seed, levels in ((1, 5), (2, 9), (3, 15)):
        again = sj.identify_backbone(states(seed, levels), modes())
        again.backbone.values(np.linspace(*(float(x) for x in ends(again)), 60 + seed))
    assert len(compilations) == 0


def test_points_of_other_numbers_of_states(compilations):
    data = states(0, 5)
    whole = np.asarray(sj.identify.identify_points(data, modes()).natural_frequency)
    del compilations[:]
    for n in (7, 20, len(data.level) - 1):
        few = sj.identify.identify_points(data.select(np.arange(n)), modes())
        np.testing.assert_array_equal(few.natural_frequency, whole[:n])
    assert len(compilations) == 0


def ends(found):
    return found.backbone.smallest, found.backbone.largest
