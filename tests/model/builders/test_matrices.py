"""Structures from matrices: against the matrices themselves, and what is refused."""

import numpy as np
import pytest
import scipy.sparse

import snrmjax as sj
from snrmjax.model.builders.matrices import chain, from_matrices

MASSES, SPRINGS, DAMPERS = (
    [1.0, 0.5, 2.0, 1.5],
    [3.0, 1.0, 2.0, 1.0, 0.5],
    [0.1, 0.0, 0.3, 0.0, 0.2],
)


def exact(matrices, load, omega):
    """Velocities of the points under a load, by the matrices."""
    m, c, k, _ = matrices
    return 1j * omega * np.linalg.solve(k - omega**2 * m + 1j * omega * c, load)


def response(model, omega):
    return np.asarray(sj.model.linear_response(model.modes, omega, 1.0))


def test_the_linear_response_is_that_of_the_matrices():
    matrices = chain(MASSES, SPRINGS, DAMPERS)
    force = {"x1": 2.0, "x3": 0.5 * np.exp(0.7j)}
    model = from_matrices(*matrices, force=force)
    assert model.modes.damping_coupling is not None
    for omega in (0.3, 1.1, 2.9):
        wanted = exact(matrices, [2.0, 0.0, 0.5 * np.exp(0.7j), 0.0], omega)
        np.testing.assert_allclose(response(model, omega), wanted, rtol=1e-11)


def test_forced_responses_of_coupled_damping_and_lagging_forces_are_linear_ones():
    matrices = chain(MASSES[:2], [1.0, 0.4, 0.7], [0.05, 0.02, 0.0])
    force = {"x1": 1.0, "x2": 0.8j}
    model = from_matrices(*matrices, force=force)
    curve = sj.forced_response(model, 0.3, 0.5, 3.0, harmonic_order=1)[0]
    for k in (0, len(curve.frequency) // 2, -1):
        wanted = 0.3 * exact(matrices, [1.0, 0.8j], curve.frequency[k])
        np.testing.assert_allclose(curve.velocity[k, 1], wanted, rtol=1e-7)
    # A stable linear structure has the multipliers e^(λT) of its eigenvalues λ.
    m, c, k, _ = matrices
    zero, eye = np.zeros((2, 2)), np.eye(2)
    below = -np.linalg.solve(m, np.hstack([k, c]))
    values = np.linalg.eigvals(np.vstack([np.hstack([zero, eye]), below]))
    wanted = np.exp(values * 2 * np.pi / curve.frequency[0])
    result = curve.multipliers[0]
    np.testing.assert_allclose(np.sort_complex(result), np.sort_complex(wanted), rtol=1e-7)


def test_what_is_left_out_gives_way_statically():
    """Ten masses of fifty: without residuals the static answer misses, with them it is exact."""
    size = 50
    matrices = chain(np.full(size, 0.02), np.full(size + 1, 50.0), 0.0)
    spring = sj.model.make_effect(
        "cubic_stiffness", {"coefficient": 1.0}, at=sj.model.between("x7", "x9")
    )
    model = from_matrices(*matrices, force="x20", effects=spring, n_modes=10)
    assert model.n_modes == 12
    low = response(model, 1e-3) / (1e-3j)
    static = np.linalg.solve(matrices.stiffness, np.eye(size))
    np.testing.assert_allclose(low[19].real, static[19, 19], rtol=1e-6)
    row = np.asarray(model.modes.shape_at("x7") - model.modes.shape_at("x9"))
    way = row**2 @ (1 / np.asarray(model.modes.natural_frequency) ** 2)
    along = np.eye(size)[6] - np.eye(size)[8]
    assert way == pytest.approx(along @ static @ along, rel=1e-9)
    few = from_matrices(*matrices, force="x20", n_modes=10)
    assert (
        abs(row[:10] ** 2 @ (1 / np.asarray(model.modes.natural_frequency[:10]) ** 2) / way - 1)
        > 0.1
    )
    assert few.n_modes == 11


def test_sparse_matrices_are_dense_ones():
    matrices = chain(MASSES, SPRINGS, DAMPERS)
    sparse = [scipy.sparse.csr_matrix(part) for part in matrices[:3]]
    one, two = (
        from_matrices(*parts, matrices.points, force="x2") for parts in (matrices[:3], sparse)
    )
    np.testing.assert_allclose(one.modes.natural_frequency, two.modes.natural_frequency, rtol=1e-12)


def test_many_unknowns_keep_their_first_modes():
    """3 000 masses as a rod: ω = 2√(k/m) sin(jπ/(2(n + 1)))."""
    size = 3000
    eye = scipy.sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (size, size)) * 1e6
    model = from_matrices(
        scipy.sparse.eye(size) * 1e-3, 0.01, eye, force="x1500", n_modes=5, sensors=["x1500"]
    )
    wanted = 2 * np.sqrt(1e9) * np.sin(np.arange(1, 6) * np.pi / (2 * (size + 1)))
    np.testing.assert_allclose(model.modes.natural_frequency[:5], wanted, rtol=1e-9)
    assert model.modes.sensors == ("x1500",)


def test_a_free_structure_has_rigid_body_modes():
    matrices = chain([1.0, 2.0], [0.0, 3.0, 0.0])
    model = from_matrices(*matrices, force="x1")
    assert model.n_modes == 1
    assert model.modes.rigid_body_shape.shape == (2, 1)
    wanted = exact(matrices, [1.0, 0.0], 0.9)
    np.testing.assert_allclose(response(model, 0.9), wanted, rtol=1e-10)


M, C, K = chain([1.0, 1.0], [1.0, 1.0, 1.0])[:3]


def changed(matrix, entry, value):
    other = matrix.copy()
    other[entry] = value
    return other


@pytest.mark.parametrize(
    ("parts", "settings", "message"),
    [
        ((M[:, :1], C, K), {}, r"`mass` must be a square matrix"),
        ((M, C, K[0]), {}, r"`stiffness` must be a square matrix"),
        ((M, C, changed(K, (0, 1), -1.5)), {}, r"`stiffness` must be symmetric"),
        ((changed(M, (0, 1), 0.1), C, K), {}, r"`mass` must be symmetric"),
        ((M, changed(C, (0, 1), 0.1), K), {}, r"`damping` must be symmetric"),
        ((-M, C, K), {}, r"`mass` must be positive definite"),
        ((M * 0, C, K), {}, r"`mass` must be positive definite"),
        ((M, C, -K), {}, r"`stiffness` must not be negative.* rests at x₀ = √\(−k/c\)"),
        ((M, C, K * np.nan), {}, r"`stiffness` must be finite"),
        ((M, C, np.eye(3)), {}, r"`mass` has shape \(2, 2\), but `stiffness` has \(3, 3\)"),
        ((M, np.eye(3), K), {}, r"`damping` has shape \(3, 3\), but there are 2"),
        ((M, 1.5, K), {}, r"`damping_ratio` must be from 0 to below 1"),
        ((M, C, None), {}, r"`stiffness` must be a matrix"),
        ((M, C, K), {"points": ["a"]}, r"names 1 points, but there are 2 unknowns"),
        ((M, C, K), {"points": ["a", "a"]}, r"names 'a' twice"),
        ((M, C, K), {"force": "x3"}, r"`force` names the point 'x3'.*known are x1, x2"),
        ((M, C, K), {"force": {}}, r"excites no mode"),
        ((M, C, K), {"force": {"x1": 0.0}}, r"excites no mode"),
        ((M, C, K), {"sensors": ["tip"]}, r"`sensors` names the point 'tip'"),
        ((M, C, K), {"n_modes": 0}, r"`n_modes` must lie between 1 and 2"),
        ((M, C, K), {"n_modes": 3}, r"`n_modes` must lie between 1 and 2"),
        ((M, C, K), {"mode_of_interest": 2}, r"`mode_of_interest` must lie between 0 and 1"),
        ((M, C, K * 0), {}, r"`stiffness` is zero for every motion"),
    ],
)
def test_what_is_no_structure_is_refused(parts, settings, message):
    with pytest.raises(ValueError, match=message):
        from_matrices(*parts, **{"force": "x1", **settings})


def test_a_mass_without_a_linear_spring_is_a_mode_of_zero_frequency():
    spring = sj.model.make_effect("cubic_stiffness", {"coefficient": 1.0}, at="x1")
    held = from_matrices(*chain([1.0, 2.0], [0.0, 3.0, 0.0]), force="x1", effects=spring).modes
    np.testing.assert_allclose(held.natural_frequency, [np.sqrt(3 * 1.5), 0.0])
    np.testing.assert_allclose(np.abs(held.mode_shape[:, 1]), 3**-0.5)  # together, of 3 kg
    assert held.rigid_body_shape.shape == (2, 0)
    # Between the points it feels nothing of the rigid-body motion, which stays one.
    inside = sj.model.make_effect("cubic_stiffness", {"coefficient": 1.0}, at={"x1": 1, "x2": -1})
    free = from_matrices(*chain([1.0, 2.0], [0.0, 3.0, 0.0]), force="x1", effects=inside).modes
    assert (free.n_modes, free.rigid_body_shape.shape) == (1, (2, 1))


def bent(n, length, first=0):
    """Stiffness of unit E I of the elements from `first` on of a clamped beam, and its mass."""
    h = length / n
    k = np.array([[12, 6 * h, -12, 6 * h], [0, 4 * h**2, -6 * h, 2 * h**2], [0, 0, 12, -6 * h]])
    k = np.vstack([k, [0, 0, 0, 4 * h**2]])
    m = np.array([[156, 22 * h, 54, -13 * h], [0, 4 * h**2, 13 * h, -3 * h**2]])
    m = np.vstack([m, [0, 0, 156, -22 * h], [0, 0, 0, 4 * h**2]])
    made = []
    for part, start in ((k / h**3, first), (m * h / 420, 0)):
        whole = part + np.triu(part, 1).T
        at = 2 * np.arange(start, n)[:, None, None] + np.stack(np.indices((4, 4)))[:, None]
        values = np.broadcast_to(whole, at.shape[1:]).ravel()
        size = 2 * n + 2
        made.append(scipy.sparse.csc_array((values, at.reshape(2, -1)), (size, size))[2:, 2:])
    return made


@pytest.mark.parametrize("n", [400, 5000])
def test_damping_of_a_fine_mesh_is_no_small_difference(n):
    # 5 000 elements lost a hundredth of 2ζω = β ω² to rounding; half of a beam: its strain energy.
    stiffness, mass = bent(n, 1.0)
    model = from_matrices(mass, 1e-3 * stiffness, stiffness, force="x5", n_modes=2, sensors=["x5"])
    ratio = np.asarray(model.modes.damping_ratio[:2])
    omega = np.asarray(model.modes.natural_frequency[:2])
    np.testing.assert_allclose(ratio, 0.5e-3 * omega, rtol=1e-12)
    half = bent(n, 1.0, first=n // 2)[0]
    both = from_matrices(
        *(mass, (1e-3 * stiffness + 3e-3 * half).tocsc(), stiffness),
        **{"force": "x5", "n_modes": 2, "sensors": ["x5"]},
    )
    first = 1.875104068711961  # of cosh x cos x = −1
    x = (np.arange(20000) + 0.5) / 20000
    ratio = (np.sinh(first) - np.sin(first)) / (np.cosh(first) + np.cos(first))
    bend = np.cosh(first * x) + np.cos(first * x)
    bend = (bend - ratio * (np.sinh(first * x) + np.sin(first * x))) ** 2
    wanted = (1e-3 + 3e-3 * bend[x > 0.5].sum() / bend.sum()) * first**2 / 2
    # What rounding of the entries themselves leaves is stated.
    result, std = both.modes.damping_ratio.item(0), both.modes.damping_ratio_std.item(0)
    assert result == pytest.approx(wanted, rel=1e-6, abs=std)


def test_a_sum_of_mass_and_stiffness_of_equal_elements_is_within_its_stated_error():
    # All entries of a diagonal round alike: a M is 90 units in the last digit of b K.
    n, stiffness = 10_000, 100.0
    h = 1.0 / (n + 1)
    second = scipy.sparse.diags_array(
        [1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n), format="csc"
    )
    k, m = stiffness / h**3 * (second @ second), h * scipy.sparse.eye_array(n, format="csc")
    # Of the hinged beam of finite differences, mode by mode.
    omega = np.sqrt(stiffness) * (2 - 2 * np.cos(np.pi * h * np.array([1, 2]))) / h**2
    a, b = 1.8, 2e-5
    model = from_matrices(m, a * m + b * k, k, force="x5", n_modes=2, sensors=["x5"])
    ratio, std = (
        np.asarray(part[:2]) for part in (model.modes.damping_ratio, model.modes.damping_ratio_std)
    )
    wanted = a / (2 * omega) + b * omega / 2
    assert np.all(np.abs(ratio - wanted) < std)
    assert np.all(std < 0.03 * wanted)


@pytest.mark.parametrize(
    ("springs", "dampers", "message"),
    [([1.0, 1.0], 0.0, "`springs` must have 3"), ([1.0] * 3, [0.1], "`dampers` must have 3")],
)
def test_a_chain_of_other_lengths_is_refused(springs, dampers, message):
    with pytest.raises(ValueError, match=message):
        chain([1.0, 1.0], springs, dampers)
