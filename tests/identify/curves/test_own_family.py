"""A user's own family: its curve, its fitted numbers, and response prediction."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import CONSTANT, NOISE, modes, squared, stated

import snrmjax as sj
from snrmjax.identify.curves.family_base import packed

SLIDES = 0.08  # m/s
AT = np.array([0.03, 0.06, 0.1, 0.3, 0.8])


class ViscousSliding(sj.identify.OwnFamily):
    """Viscous damping, and dry friction whose sign is a hyperbolic tangent of the velocity."""

    kind = "viscous_sliding"
    names = ("viscous", "friction")
    nonlinear_parameters: ClassVar = {"speed": (0.05, 0.3)}

    @classmethod
    def columns(cls, x, speed):
        """See `OwnFamily`."""
        return [jnp.ones_like(x), jnp.tanh(x / speed) / x]


def damping(v):
    """2ζ̃ω̃ in 1/s."""
    return 12.0 + 3.0 * np.tanh(v / SLIDES) / v


def slipping(noise):
    """States of nine levels with the exact damping, and a multiple of the usual noise."""
    rows = []
    for level, tip in enumerate(np.geomspace(5e-5, 2e-3, 9)):
        for phase in np.radians(np.linspace(-60, 60, 9)):
            x = tip * np.cos(phase)
            omega = np.sqrt(squared(x))
            for _ in range(200):
                omega = np.sqrt(squared(x) - omega * damping(x * omega) * np.tan(phase))
            needed = squared(x) - omega**2 + 1j * omega * damping(x * omega)
            force = abs(needed) * x / CONSTANT
            rows.append((level, omega, force, 1j * omega * CONSTANT * force / needed))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    rng, n = np.random.default_rng(0), len(level)
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    return stated(level, omega, force, velocity * np.exp(noise * own))


@pytest.fixture(scope="module")
def fit():
    """Fitted by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sj.identify.FAMILIES, "viscous_sliding", ViscousSliding)
        return sj.fit_jointly(
            slipping(0.5),
            modes(),
            backbone="polynomial:1",
            damping="viscous_sliding@velocity",
        )


def test_a_fit_finds_the_numbers_of_an_own_family(fit):
    assert [note.kind for note in fit.notes if note.kind == "family_leaves"] == []
    index = fit.names().index("damping.log_speed")
    value, std = (
        np.asarray(one)[index] for one in (fit.vector()[0], np.sqrt(np.diag(fit.covariance)))
    )
    curve = fit.unknowns.modal_damping
    assert curve.label == "viscous_sliding@velocity"
    assert std < 0.05
    assert abs(value - np.log(SLIDES / float(curve.scale))) < 3 * std
    values = sj.identify.fitted_values(fit, AT)
    assert np.all(np.abs(values.modal_damping - damping(AT)) < 3 * values.modal_damping_std)


def test_programs_have_the_curve_and_its_slopes(fit):
    curve = fit.unknowns.modal_damping
    general, host = packed(curve), curve.linearised(AT)
    # A spline through 64 values, about one per 2 % of the largest amplitude.
    np.testing.assert_allclose(general(AT), host.value, rtol=1e-3)
    slopes = jax.jacfwd(lambda p: general.__class__(**{**vars(general), "parameters": p})(AT))(
        general.parameters
    )
    unit = np.abs(host.by_parameters).max(axis=0)
    np.testing.assert_allclose(slopes[:, :3] / unit, host.by_parameters / unit, atol=5e-3)
    ends = [curve.linearised(AT * (1 + sign * 1e-5)).value for sign in (1, -1)]
    np.testing.assert_allclose(host.by_amplitude, np.subtract(*ends) / (2e-5 * AT), rtol=1e-6)


def test_responses_follow_from_an_own_family(fit):
    (found,) = sj.identify.fitted_response(fit, 1.0)[0].resonances
    # At phase resonance the force balances the damping: A F = δ(v) v.
    assert damping(found.velocity) * found.velocity == pytest.approx(CONSTANT, rel=2e-2)


def test_the_remainder_of_an_own_family_is_fitted():
    class Viscous(sj.identify.OwnFamily):
        kind = "own_viscous"
        names = ("viscous",)

        @classmethod
        def columns(cls, x):
            return [jnp.ones_like(x)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sj.identify.FAMILIES, "own_viscous", Viscous)
        fit = sj.fit_jointly(
            slipping(0.5), modes(), backbone="polynomial:1", damping="own_viscous@velocity"
        )
    (note,) = (one for one in fit.notes if one.kind == "family_leaves")
    assert note["curve"] == "damping"
    values = sj.identify.fitted_values(fit, AT[1:])
    off = (values.modal_damping - damping(AT[1:])) / values.modal_damping_std
    assert np.max(np.abs(off)) < 3
