"""Laws given by knots: against formulas and SciPy's integration in time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.diagnose.kinds.registry import idle_effect
from snrmjax.io.models import read_model, write_model
from snrmjax.model.effects import LAWS, make_effect
from snrmjax.model.parameters import parameter_names, parameter_value, with_parameters

KNOTS = np.geomspace(0.05, 1.0, 18)  # a ratio of 1.19
# Where each law has its knots, its tables, and the formula that they sample: (q, v) to force.
TABLES = {
    "stiffness_law": (
        {"displacement": KNOTS, "restoring_force": KNOTS**3},
        lambda q, v: q**3,
    ),
    "displacement_damping_law": (
        {"displacement": KNOTS, "coefficient": np.sin(KNOTS)},
        lambda q, v: np.sin(np.abs(q)) * v,
    ),
}


def law(kind):
    return make_effect(kind, TABLES[kind][0])


@pytest.mark.parametrize("kind", TABLES)
def test_a_law_follows_the_formula_between_its_knots_and_is_zero_at_rest(kind):
    q, v = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 42))
    inside = (np.abs(q) > KNOTS[0]) & (np.abs(v) > KNOTS[0])
    force = np.asarray(jax.vmap(jax.vmap(law(kind).force))(jnp.asarray(q), jnp.asarray(v)))
    # A local cubic over a ratio of 1.19 is off by (ln 1.19)³ times a third derivative.
    np.testing.assert_allclose(force[inside], TABLES[kind][1](q, v)[inside], rtol=0, atol=2e-3)
    assert law(kind).force(jnp.array(0.0), jnp.array(0.0)) == 0.0


@pytest.mark.parametrize("kind", TABLES)
def test_a_law_has_a_finite_slope_everywhere_and_goes_on_straight(kind):
    def force(x):
        other = jnp.array(1.0) if kind == "displacement_damping_law" else x
        return law(kind).force(x, other)

    def line(x):  # of a damping by displacement the force c(|q|)|q| is straight
        return force(x) * (x if kind == "displacement_damping_law" else 1.0)

    at = jnp.linspace(-3.0, 3.0, 121)
    slope = np.asarray(jax.vmap(jax.grad(force))(at))
    assert np.isfinite(slope).all()
    beyond = np.asarray(jax.vmap(jax.grad(line))(jnp.array([1.0001, 1.5, 3.0])))
    np.testing.assert_allclose(beyond, beyond[0], rtol=1e-9)
    before = float(jax.grad(line)(jnp.array(0.9999)))
    assert before == pytest.approx(beyond[0], rel=2e-3)  # the slope is continuous


def steady(extra, force, omega, cycles=120):
    """Complex fundamental of q of q̈ + 0.04q̇ + q + extra = force cos Ωt, by SciPy."""
    period = 2 * np.pi / omega
    times = (cycles + np.arange(64) / 64) * period
    solved = solve_ivp(
        lambda t, y: [y[1], force * np.cos(omega * t) - y[0] - 0.04 * y[1] - extra(y[0], y[1])],
        (0.0, times[-1]),
        [0.0, 0.0],
        method="DOP853",
        rtol=1e-9,
        atol=1e-12,
        t_eval=times,
    )
    return 2 * np.mean(solved.y[0] * np.exp(-1j * omega * times))


@pytest.mark.long
def test_a_law_simulates_what_its_formula_does_in_time():
    """A spring that saturates, k w tanh(q/w) less its slope at rest: softening by 12 %."""
    spring = lambda q, v: 0.25 * (0.5 * np.tanh(q / 0.5) - q)  # noqa: E731
    drawn = make_effect(
        "stiffness_law", {"displacement": KNOTS, "restoring_force": spring(KNOTS, 0.0)}
    )
    model = sj.model.structure(sj.model.linear_modes([1.0], [0.02], [[1.0]], [1.0]), effects=drawn)
    (curve,) = sj.forced_response(model, 0.036, 0.7, 1.3, harmonic_order=5, stability=False)
    frequency, speed = np.asarray(curve.frequency), np.asarray(curve.velocity)[:, 1, 0]
    for omega in (0.85, 0.95, 1.05):
        assert np.sum(np.diff(frequency > omega)) == 1  # one motion there
        result = np.interp(omega, frequency, np.abs(speed)) / omega
        # The table is off by 2e-3 of the spring; the curve is drawn between points.
        assert result == pytest.approx(abs(steady(spring, 0.036, omega)), rel=5e-3)


@pytest.mark.parametrize("kind", LAWS)
def test_a_model_with_a_law_returns_from_its_file_with_named_values(kind, tmp_path):
    modes = sj.model.linear_modes([1.0], [0.02], [[1.0]], [1.0])
    model = sj.model.structure(modes, effects=law(kind))
    write_model(tmp_path / "model.toml", model)
    back = read_model(tmp_path / "model.toml").effects[0]
    assert type(back) is type(model.effects[0])
    for name in back.parameters():
        np.testing.assert_array_equal(getattr(back, name), getattr(model.effects[0], name))
    names = [name for name in parameter_names(model) if name.startswith(kind)]
    values = {name.rpartition(".")[2].rpartition("_")[0] for name in names}
    assert values == set(back.parameters()) - {"displacement"}
    last = names[-1]
    other = with_parameters(model, [last], jnp.array([7.5]))
    assert float(parameter_value(other, last)) == 7.5
    assert float(parameter_value(other, names[0])) == float(parameter_value(model, names[0]))
    idle = idle_effect(model.effects[0], 1.0, 0.02)
    t = jnp.linspace(0, 2 * np.pi, 64, endpoint=False)
    np.testing.assert_array_equal(idle.cycle_force(jnp.cos(t), -jnp.sin(t)), 0.0)


BAD = {
    "one knot": ({"displacement": [1.0], "restoring_force": [1.0]}, "two numbers or more"),
    "a number": ({"displacement": 1.0, "restoring_force": 1.0}, "two numbers or more"),
    "other lengths": ({"displacement": [1.0, 2.0], "restoring_force": [1.0] * 3}, "2 numbers"),
    "falling": ({"displacement": [2.0, 1.0], "restoring_force": [1.0] * 2}, "1 after 2"),
    "at rest": ({"displacement": [0.0, 1.0], "restoring_force": [1.0] * 2}, "positive"),
}


@pytest.mark.parametrize("case", BAD)
def test_refuses_tables_that_are_none(case):
    tables, message = BAD[case]
    with pytest.raises(ValueError, match=message) as error:
        make_effect("stiffness_law", {name: np.array(v) for name, v in tables.items()})
    assert "stiffness_law" in str(error.value)


def test_refuses_a_file_whose_law_has_a_text_among_its_numbers(tmp_path):
    path = tmp_path / "model.toml"
    path.write_text(
        "[[mode]]\nfrequency_hz = 1\ndamping_ratio = 0.1\nshape = { a = 1 }\nparticipation = 1\n"
        '[[effect]]\nkind = "stiffness_law"\ndisplacement = [1, 2]\nrestoring_force = [1, "2"]\n'
    )
    with pytest.raises(ValueError, match=r"restoring_force.*effect 1 of model.toml.*knot 2"):
        read_model(path)
