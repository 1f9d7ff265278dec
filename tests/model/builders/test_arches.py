"""The shallow arch against beam theory, its own energy integrated, and the published beams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.special import ellipk

import snrmjax as sj
from snrmjax.model.builders.beams import curved_beam, flat_beam

HZ = 2 * np.pi
PLACE, WEIGHT = (np.polynomial.legendre.leggauss(40) + np.array([[1.0], [0.0]])) / 2
STEEL = {"young": 204e9, "density": 7860.0, "damping_ratio": 0.05}
CURVED = (0.3048, 0.0127, 0.508e-3, 0.3048**2 / (8 * 11.43))  # Tab. 3 of the method paper
FLAT = (0.2286, 0.0127, 0.787e-3, 0.0)  # Tab. 1
FLAT_STEEL = {"young": 204.8e9, "density": 7870.0, "damping_ratio": 0.05}


def arch(dimensions=CURVED, functions=(1, 3), **settings):
    material = settings.pop("material", STEEL)
    chosen = sj.model.ArchSettings(functions, **settings)
    return sj.model.shallow_arch(*dimensions, **material, settings=chosen)


def coefficient(model, key):
    values = dict(
        zip(model.potential.monomials, np.asarray(model.potential.coefficient), strict=True)
    )
    return values[tuple(int(digit) - 1 for digit in key)]


def test_a_straight_beam_has_the_frequencies_of_the_textbook():
    length, width, thickness = 0.4, 0.02, 0.002
    model = arch((length, width, thickness, 0.0), (1, 2, 3, 4, 5))
    # Roots of cos λ cosh λ = 1 to nine digits, as in handbooks.
    wave = np.array([4.73004074, 7.85320462, 10.9956078, 14.1371655, 17.2787597])
    section = np.sqrt(204e9 * thickness**2 / 12 / 7860.0)
    expected = (wave / length) ** 2 * section
    np.testing.assert_allclose(model.modes.natural_frequency, expected, rtol=1e-8)  # its digits
    # Mass-normalised with mean square 1: the first mode's value at midspan and its mean.
    root_mass = np.sqrt(7860.0 * length * width * thickness)
    assert float(model.modes.mode_shape[0, 0]) * root_mass == pytest.approx(1.588146, rel=1e-6)
    assert float(model.modes.participation[0]) * root_mass == pytest.approx(0.830862, rel=1e-6)
    np.testing.assert_allclose(model.modes.participation[1::2], 0.0, atol=1e-9)


def test_a_straight_beam_stiffens_as_published():
    # Nonlinear over linear frequency of the clamped beam's first mode at amplitudes of one, two and
    # three radii of gyration, as the literature has it of one mode by elliptic functions.
    model = arch((0.4, 0.02, 0.002, 0.0), (1,))
    radius = 0.002 / np.sqrt(12)
    squared = float(model.modes.natural_frequency[0]) ** 2
    beta = 4 * coefficient(model, "1111")
    for times, published in ((1, 1.0222), (2, 1.0857), (3, 1.1833)):
        q = times * radius / float(model.modes.mode_shape[0, 0])
        hardened = squared + beta * q**2
        exact = np.pi / 2 * np.sqrt(hardened / squared) / ellipk(beta * q**2 / 2 / hardened)
        assert exact == pytest.approx(published, abs=5e-4), times


def test_the_energy_is_that_of_the_deformed_beam():
    # Bending and stretching of a displacement in three modes, its integrals by quadrature and its
    # functions by a boundary value problem: nothing of the module under test.
    length, width, thickness, rise = CURVED
    model = arch(functions=(1, 2, 3))
    numbers, modes = (1, 2, 3), [clamped_mode(k) for k in (1, 2, 3)]
    area = width * thickness
    axial, bending = 204e9 * area, 204e9 * area * thickness**2 / 12
    mass = 7860.0 * area * length
    slopes, curvatures = (np.array([m(PLACE)[k] for m in modes]) for k in (1, 2))

    def energy(a):
        slope = a @ slopes / length
        strain = slope * 4 * rise / length * (1 - 2 * PLACE) + slope**2 / 2
        bent = WEIGHT @ (a @ curvatures / length**2) ** 2
        return 0.5 * length * (bending * bent + axial * (WEIGHT @ strain) ** 2)

    # To modal coordinates by shapes at as many places as there are modes.
    places = (0.2, 0.45, 0.7)
    seen = np.array(
        [arch(functions=numbers, sensor_position=s).modes.mode_shape[0] for s in places]
    )
    basis = np.array([[m(s)[0] for m in modes] for s in places])
    assert mass * np.sum(np.linalg.solve(basis, seen)[:, 0] ** 2) == pytest.approx(1, rel=1e-6)
    for a in np.random.default_rng(0).normal(scale=thickness, size=(4, 3)):
        q = np.linalg.solve(seen, basis @ a)
        assert float(model.potential_energy(jnp.asarray(q))) == pytest.approx(energy(a), rel=1e-5)


def clamped_mode(number):
    """A mode of the clamped-clamped beam with mean square 1 as (φ, φ', φ'') by collocation."""
    s = np.linspace(0, 1, 201)
    guess = np.array([np.sin(number * np.pi * s) * np.sin(np.pi * s)] * 4)
    wave = ((number + 0.5) * np.pi) ** 4

    def equation(_, y, p):
        return np.vstack([y[1], y[2], y[3], p[0] * y[0]])

    def ends(a, b, _):
        return np.array([a[0], a[1], b[0], b[1], a[2] - 1])

    found = solve_bvp(equation, ends, s, guess, p=[wave], tol=1e-7)
    assert found.success
    size = np.sqrt(WEIGHT @ found.sol(PLACE)[0] ** 2)
    return lambda x: found.sol(x)[:3] / size


def test_one_mode_of_an_arch_has_the_closed_form():
    # EA/2L (p a + S a²/2)² beside the bending energy, with a = q/√m, p = 8h/L ∫φ and S = ∫φ'²/L;
    # ∫φ = 0.830862 and ∫φ'² = 12.30262 of the first mode as in handbooks.
    length, width, thickness, rise = CURVED
    model = arch(functions=(1,))
    area, straight = width * thickness, arch((length, width, thickness, 0.0), (1,))
    mass, axial = 7860.0 * area * length, 204e9 * area
    slope, shortening = 8 * rise / length * 0.830862, 12.30262 / length
    squared = float(straight.modes.natural_frequency[0]) ** 2 + axial / length * slope**2 / mass
    assert float(model.modes.natural_frequency[0]) ** 2 == pytest.approx(squared, rel=1e-5)
    cubic = axial / (2 * length) * slope * shortening / mass**1.5
    quartic = axial / (8 * length) * shortening**2 / mass**2
    assert coefficient(model, "111") == pytest.approx(cubic, rel=1e-5)
    assert coefficient(model, "1111") == pytest.approx(quartic, rel=1e-5)


def test_the_published_beams_are_found_from_their_dimensions():
    flat = arch(FLAT, (1, 3, 5, 7), material=FLAT_STEEL)
    paper = flat_beam()
    # The paper's finite elements are stiffer by 0.5 % in mode 7.
    np.testing.assert_allclose(
        flat.modes.natural_frequency, paper.modes.natural_frequency, rtol=6e-3
    )
    shapes = [np.abs(model.modes.mode_shape) for model in (flat, paper)]  # their signs are free
    np.testing.assert_allclose(*shapes, rtol=1e-4)
    # Its cubic coefficients are printed 2.9 times too small; three finite element formulations,
    # of ±1.1 thicknesses, give 3.71e13 to 3.91e13.
    ratio = coefficient(flat, "1111") / coefficient(paper, "1111")
    assert 2.8 < ratio < 3.0
    assert 4 * coefficient(flat, "1111") == pytest.approx(3.8e13, rel=0.07)
    curved, printed = arch(functions=(1, 3, 5)), curved_beam("as_printed")
    assert float(curved.modes.natural_frequency[0]) / HZ == pytest.approx(64.78, rel=3e-3)
    # Positive q is away from the centre of curvature here, towards it there.
    assert coefficient(curved, "111") == pytest.approx(-coefficient(printed, "111"), rel=0.02)
    assert 2.0 < coefficient(curved, "1111") / coefficient(printed, "1111") < 3.3


def test_it_is_differentiable_in_its_dimensions():
    def numbers(x):
        model = sj.model.shallow_arch(*x[:4], young=x[4], density=x[5], damping_ratio=x[6])
        return jnp.concatenate([model.modes.natural_frequency, model.potential.coefficient])

    x = jnp.array([*CURVED, 204e9, 7860.0, 0.05])
    slopes = jax.jit(jax.jacfwd(numbers))(x)
    for k in range(7):
        step = jnp.zeros(7).at[k].set(1e-5 * x[k])
        differences = (numbers(x + step) - numbers(x - step)) / (2e-5 * x[k])
        scale = np.asarray(numbers(x) / x[k])
        # Central differences: of second order in a step of 1e-5.
        np.testing.assert_allclose((slopes[:, k] - differences) / scale, 0.0, atol=1e-6)


def test_lengths_scale():
    # Twice the size in every direction: half the frequencies, twice the midspan flexibility.
    one, two = arch(), arch(tuple(2 * x for x in CURVED))
    np.testing.assert_allclose(two.modes.natural_frequency, one.modes.natural_frequency / 2, 1e-9)
    # Energy at twice the displacement grows as length cubed.
    q = jnp.array([1e-4, -2e-5])
    larger = two.potential_energy(2 * 8**0.5 * q)
    assert float(larger) == pytest.approx(8 * float(one.potential_energy(q)), rel=1e-9)


def test_a_force_in_one_place_works_where_it_is_seen():
    model = arch(sensor_position=0.3, force_position=0.3)
    np.testing.assert_allclose(model.modes.participation, model.modes.mode_shape[0], rtol=1e-12)
    assert model.modes.sensors == ("sensor",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": 0.0}, "`thickness` must be positive, but is 0"),
        ({"rise": -1e-3}, "`rise` must be zero or positive, but is -0.001"),
        ({"rise": 0.05}, "`rise` must be at most a tenth of the length, 0.03048 m"),
        ({"young": np.inf}, "`young` must be finite"),
        ({"width": np.ones(2)}, "`width` must be one number"),
        ({"damping_ratio": 1.0}, "`damping_ratio` must be from 0 to below 1"),
        ({"damping_ratio": [0.1] * 3}, "`damping_ratio` must be one number or 2"),
    ],
)
def test_impossible_arches_are_refused(change, message):
    named = dict(zip(("length", "width", "thickness", "rise"), CURVED, strict=True))
    with pytest.raises(ValueError, match=message):
        sj.model.shallow_arch(**{**named, **STEEL, **change})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"functions": ()}, "distinct numbers"),
        ({"functions": (1, 1)}, "distinct numbers"),
        ({"functions": (0, 1)}, "from 1 to 20"),
        ({"sensor_position": 1.0}, "`sensor_position` must be between 0 and 1"),
        ({"force_position": -0.1}, "`force_position` must be between 0 and 1"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        arch(**settings)
