"""Bands of curves, read from a grid or from points, against curves known in closed form."""

import numpy as np
import pytest
import xarray as xr

from snrmjax.study.analysis import bands
from snrmjax.study.analysis.bands import curve_bands
from snrmjax.study.computations.responses import bounds_over

SIZES = np.linspace(0.5, 1.5, 41)  # one for each member: the median is 1, 95 % are within 0.475
GRID = np.linspace(10.0, 20.0, 11)


def shape(x):
    """Linear, so that points joined by straight lines lose nothing."""
    return 2.0 + 0.1 * x


def gridded(forces=None):
    rows = SIZES[:, None] * shape(GRID)
    dims = ("member", "frequency_hz")
    if forces is not None:
        rows = rows[:, None, :] * np.array(forces)[None, :, None]
        dims = ("member", "force_n", "frequency_hz")
    coordinates = {"frequency_hz": GRID} | ({} if forces is None else {"force_n": forces})
    named = dict.fromkeys(("upper_velocity_m_s", "lower_velocity_m_s"), (dims, rows))
    return xr.Dataset(named, coordinates)


def ragged(forces):
    """The same curves by points of their own, in both directions, each in two branches."""
    counts, parts = [], []
    random = np.random.default_rng(0)
    for size in SIZES:
        for force in forces:
            x = np.sort(random.uniform(10.0, 20.0, random.integers(3, 9)))
            x = np.concatenate([[10.0], x, [20.0]])[:: random.choice([-1, 1])]
            # A second branch far away: no line may lead from one branch to the other.
            away = np.array([30.0, 31.0])
            branch = np.repeat([0, 1], [len(x), 2])
            y = np.concatenate([size * force * shape(x), [0.0, 0.0]])
            counts.append(len(y))
            parts.append((np.concatenate([x, away]), 0.6 * y, 0.8 * y, branch))
    x, re, im, branch = (np.concatenate(column) for column in zip(*parts, strict=True))
    at = ("point",)
    return xr.Dataset(
        {
            "n_points": (("member", "force_n"), np.reshape(counts, (len(SIZES), len(forces)))),
            "point_frequency_hz": (at, x),
            "point_velocity_re_m_s": (at, re),
            "point_velocity_im_m_s": (at, im),
            "point_branch": (at, branch),
        },
        {"force_n": forces},
    )


def check(panel, force):
    band = panel.upper
    known = (band.at >= 10.0) & (band.at <= 20.0)
    one = force * shape(band.at[known])
    for found, size in (
        *((band.median, 1.0), (band.low, 0.525), (band.high, 1.475)),
        *((band.least, 0.5), (band.most, 1.5)),
    ):
        np.testing.assert_allclose(found[known], size * one, rtol=1e-12)
    assert known.sum() > 5
    assert panel.lower is None


def test_bands_of_a_grid():
    (panel,) = curve_bands(gridded())
    check(panel, 1.0)


def test_every_force_has_a_panel(monkeypatch):
    monkeypatch.setattr(bands, "_BLOCK", 7)  # several blocks of members
    panels = curve_bands(gridded([0.001, 0.002]))
    assert [one.force for one in panels] == [0.001, 0.002]
    for panel, force in zip(panels, (0.001, 0.002), strict=True):
        check(panel, force)


def test_points_give_the_same_bands_as_a_grid(monkeypatch):
    monkeypatch.setattr(bands, "_BLOCK", 7)
    panels = curve_bands(ragged([0.5, 1.0]))
    for panel, force in zip(panels, (0.5, 1.0), strict=True):
        check(panel, force)
        between = (panel.upper.at > 20.0) & (panel.upper.at < 30.0)
        assert between.any()
        assert np.isnan(panel.upper.most[between]).all()


def test_bounds_of_a_circle():
    angle = np.linspace(0, 2 * np.pi, 2001)
    at = np.linspace(-1.2, 1.2, 25)
    begins = np.arange(2001) == 0
    low, high = bounds_over(np.zeros(2001, dtype=int), np.cos(angle), np.sin(angle), at, begins, 1)
    inside = np.abs(at) < 1
    truth = np.sqrt(1 - at[inside] ** 2)
    # The polygon lies inside the circle by at most π²/(2·1000²) of the radius.
    np.testing.assert_allclose(high[0, inside], truth, atol=1e-4)
    np.testing.assert_allclose(low[0, inside], -truth, atol=1e-4)
    assert np.isnan(high[0, np.abs(at) > 1.01]).all()


def test_backbones_that_end_early_end_the_band():
    ends = np.where(np.arange(100) < 15, 1.0, 2.0)  # of 100 members, 15 end at half the velocity
    x = np.concatenate([np.linspace(0.0, end, 50) for end in ends])
    data = xr.Dataset(
        {
            "n_points": (("member",), np.full(100, 50)),
            "point_velocity_m_s": (("point",), x),
            "point_frequency_hz": (("point",), 80 + x),
            "point_damping_ratio": (("point",), 0.01 * (1 + x)),
        }
    )
    frequency, damping = curve_bands(data)
    assert frequency.upper.at[[0, -1]] == pytest.approx([0.0, 1.0])
    np.testing.assert_allclose(frequency.upper.median, 80 + frequency.upper.at, rtol=1e-12)
    np.testing.assert_allclose(damping.upper.most, 0.01 * (1 + damping.upper.at), rtol=1e-12)


def test_many_members_are_sampled_for_quantiles_but_not_for_extremes():
    n = 3 * bands.SAMPLED
    rows = np.random.default_rng(1).standard_normal((n, 3))
    rows[7, 1] = 40.0
    named = dict.fromkeys(("upper_velocity_m_s",), (("member", "frequency_hz"), rows))
    named["lower_velocity_m_s"] = named["upper_velocity_m_s"]
    (panel,) = curve_bands(xr.Dataset(named, {"frequency_hz": [1.0, 2.0, 3.0]}))
    assert panel.upper.most[1] == 40.0
    # Quantiles of a normal distribution; five standard errors with 4096 members.
    np.testing.assert_allclose(panel.upper.high, 1.96, atol=5 * np.sqrt(0.025 / 4096) / 0.0584)
    np.testing.assert_allclose(panel.upper.median, 0.0, atol=5 * 1.2533 / np.sqrt(4096))
