"""Kinds of excitation, and masses without a linear spring, against time integration."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.io import results
from snrmjax.io.models import write_model
from snrmjax.pipelines.simulate import simulate_responses

HERTZ = 2 * np.pi
BASE = '\n[base]\nmotion = "absolute"\n'
MASS, CUBIC, UNBALANCE = np.diag([1.0, 0.5]), 4e7, 2e-4
STIFFNESS = np.array([[3e4, -1e4], [-1e4, 1e4]])
DAMPING = 2e-4 * STIFFNESS
ROTOR = f"""
[structure]
points = ["a", "b"]
mass = {MASS.tolist()}
stiffness = {STIFFNESS.tolist()}
damping = {DAMPING.tolist()}
[force]
at = {{ a = 1.0 }}
unbalance_kg_m = {UNBALANCE}
[[effect]]
kind = "cubic_stiffness"
at = "b"
coefficient = {CUBIC}
"""
ABSORBER = """
[structure]
points = ["a", "b"]
mass = [[1.0, 0.0], [0.0, 0.05]]
stiffness = [[1e4, 0.0], [0.0, 0.0]]
damping = [[1.3, -0.3], [-0.3, 0.3]]
[force]
at = { a = 1.0 }
[[effect]]
kind = "cubic_stiffness"
between = ["b", "a"]
coefficient = 5e6
"""


def read(folder, text):
    (folder / "model.toml").write_text(text)
    return sj.read_model(folder / "model.toml")


def miss_after_a_period(model, branch, point, matrices, force, inner):
    """Relative mismatch of a motion after time integration of the matrices over a period."""
    mass, damping, stiffness = matrices
    omega, x = branch.frequency[point], branch.coefficients[point]
    x = x @ np.asarray(model.modes.mode_shape).T
    cosines, sines = (x[1::2], x[2::2]) if force else (x[1:], 0 * x[1:])
    order = np.arange(1, len(cosines) + 1)[:, None]
    begin = np.concatenate([x[0] + cosines.sum(0), omega * (order * sines).sum(0)])

    def rate(t, y):
        q, v = y[:2], y[2:]
        load = np.array([force * np.cos(omega * t), 0.0])
        left = load - damping @ v - stiffness @ q - inner(q)
        return np.concatenate([v, np.linalg.solve(mass, left)])

    end = solve_ivp(rate, (0, 2 * np.pi / omega), begin, rtol=1e-10, atol=1e-13).y
    return np.abs(end[:2, -1] - end[:2, 0]).max() / np.abs(end[:2]).max()


def test_an_unbalance_drives_by_the_square_of_the_frequency(tmp_path):
    model = read(tmp_path, ROTOR)
    (curve,) = sj.forced_response(model, [1.0], 10 * HERTZ, 32 * HERTZ, stability=False)
    assert curve.at_events("peak").size >= 2
    for point in range(3, len(curve.frequency), len(curve.frequency) // 5):
        miss = miss_after_a_period(
            *(model, curve, point, (MASS, DAMPING, STIFFNESS)),
            UNBALANCE * curve.frequency[point] ** 2,
            lambda q: np.array([0.0, CUBIC * q[1] ** 3]),
        )
        assert miss < 1e-5  # by truncation
    # Twice the unbalance of the model is the model of twice the unbalance.
    (twice,) = sj.forced_response(model, [2.0], 14 * HERTZ, 15 * HERTZ, stability=False)
    other = read(tmp_path, ROTOR.replace(f"= {UNBALANCE}", f"= {2 * UNBALANCE}"))
    (same,) = sj.forced_response(other, [1.0], 14 * HERTZ, 15 * HERTZ, stability=False)
    np.testing.assert_allclose(twice.velocity, same.velocity, atol=1e-9)
    # Its force in the table.
    results.write_response(tmp_path / "response.csv", [twice])
    rows = np.genfromtxt(tmp_path / "response.csv", delimiter=",", names=True)
    wanted = 2 * UNBALANCE * (HERTZ * rows["frequency_hz"]) ** 2
    np.testing.assert_allclose(rows["force_n"], wanted, rtol=1e-9)
    np.testing.assert_allclose(rows["unbalance_kg_m"], 2 * UNBALANCE)


def test_an_unbalance_in_files_of_modes_and_in_tables(tmp_path):
    model = read(tmp_path, ROTOR)
    write_model(tmp_path / "modes.toml", model)
    modes = sj.read_model(tmp_path / "modes.toml")
    assert float(modes.modes.unbalance) == UNBALANCE
    # A table without forces has those of the unbalance; a force cell's are taken as they are.
    head = "level,sensor,frequency_hz,{}velocity_re_m_s,velocity_im_m_s\n1,a,15,{}0.01,0.02\n"
    (tmp_path / "data.csv").write_text(head.format("", ""))
    data = sj.read_steady_states(tmp_path / "data.csv", modes)
    assert data.force[0] == pytest.approx(UNBALANCE * (15 * HERTZ) ** 2)
    (tmp_path / "data.csv").write_text(head.format("force_n,", "0.7,"))
    assert sj.read_steady_states(tmp_path / "data.csv", modes).force[0] == 0.7
    (tmp_path / "both.toml").write_text((tmp_path / "modes.toml").read_text() + BASE)
    with pytest.raises(ValueError, match=r"both \[force\] and \[base\]"):
        sj.read_model(tmp_path / "both.toml")
    with pytest.raises(ValueError, match="same at every frequency"):
        sj.pipelines.identify_test(data, modes, predict_force=(1.0,))


def test_an_absorber_without_a_linear_spring(tmp_path):
    model = read(tmp_path, ABSORBER)
    mass, damping = np.diag([1.0, 0.05]), np.array([[1.3, -0.3], [-0.3, 0.3]])
    stiffness = np.diag([1e4, 0.0])

    def inner(q):
        between = 5e6 * (q[1] - q[0]) ** 3
        return np.array([-between, between])

    (curve,) = sj.forced_response(model, [2.0], 10 * HERTZ, 25 * HERTZ)
    # Where the absorber takes up the energy, the response is modulated (Gendelman & Starosvetsky).
    assert curve.at_events("neimark_sacker").size == 2
    for point in range(3, len(curve.frequency), len(curve.frequency) // 5):
        matrices = mass, damping, stiffness
        assert miss_after_a_period(model, curve, point, matrices, 2.0, inner) < 1e-4
    mode = sj.nonlinear_normal_mode(model, 20 * HERTZ)
    matrices = mass, 0 * damping, stiffness
    middle = len(mode.frequency) // 2
    assert miss_after_a_period(model, mode, middle, matrices, 0.0, inner) < 1e-6
    # As modes: a rigid-body mode that the element restrains.
    write_model(tmp_path / "modes.toml", model)
    again = sj.read_model(tmp_path / "modes.toml").modes
    for name in ("natural_frequency", "mode_shape", "participation", "damping_coupling"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model.modes, name))


def test_a_force_on_another_mode_than_that_of_interest(tmp_path):
    # Two equal masses pushed apart: only their second mode moves.
    text = ABSORBER.replace("1e4, 0.0], [0.0, 0.0", "2e4, -1e4], [-1e4, 2e4").replace("0.05", "1.0")
    text = text.replace("1.3, -0.3], [-0.3, 0.3", "2.0, 0.0], [0.0, 2.0")
    model = read(tmp_path, text.replace("a = 1.0", "a = 1.0, b = -1.0"))
    assert model.modes.driven().tolist() == [False, True]
    found = simulate_responses(model, [4.0], 20.0, 40.0, harmonics=5)
    (curve,) = found.curves
    assert len(curve.frequency) < 200  # by the scale of the mode at rest there were 4 000
    (peak,), (resonance,) = curve.at_events("peak"), curve.at_events("phase_resonance")
    speed = np.abs(curve.velocity[:, 1, 0])
    assert peak == np.argmax(speed)
    assert resonance == pytest.approx(peak, abs=2)
    # x = a = −b: ẍ + 2ẋ + 3·10⁴x + 8·5·10⁶x³ = 4 cos Ωt, at resonance 2 |ẋ| = 4 by one harmonic.
    assert speed.max() == pytest.approx(2.0, rel=2e-2)
    with pytest.raises(ValueError, match="does not drive"):
        sj.simulate.phase_controlled(model, 1.0)
    data = "level,sensor,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s\n1,a,15,1,0.01,0.02\n"
    (tmp_path / "data.csv").write_text(data)
    with pytest.raises(ValueError, match="does not excite"):
        sj.read_steady_states(tmp_path / "data.csv", model)


def test_sparse_matrices_of_files(tmp_path):
    dense = read(tmp_path, ROTOR)
    parts = {"mass": MASS, "stiffness": STIFFNESS, "damping": DAMPING}
    arrays, lines = {"points": np.array(["a", "b"])}, ['points = ["a", "b"]']
    for name, matrix in parts.items():
        scipy.sparse.save_npz(tmp_path / f"{name}.npz", scipy.sparse.csc_array(matrix))
        lines.append(f'{name} = "{name}.npz"')
        with np.load(tmp_path / f"{name}.npz") as stored:
            arrays |= {f"{name}_{key}": stored[key] for key in stored.files}
    np.savez(tmp_path / "all.npz", **arrays)
    head, tail = ROTOR.split("points")[0], "[force]" + ROTOR.split("[force]")[1]
    for body in ("\n".join(lines), 'file = "all.npz"'):
        sparse = read(tmp_path, f"{head}{body}\n{tail}")
        for one, other in zip(*map(jax_leaves, (sparse, dense)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)
    np.savez(tmp_path / "all.npz", mass=scipy.sparse.csc_array(MASS), stiffness=STIFFNESS)
    with pytest.raises(ValueError, match=r"a sparse matrix, .*`scipy\.sparse\.save_npz`"):
        read(tmp_path, f'{head}file = "all.npz"\n{tail}')


def jax_leaves(model):
    modes = {
        field.name: getattr(model.modes, field.name) for field in dataclasses.fields(model.modes)
    }
    return [np.asarray(value) for value in modes.values() if hasattr(value, "shape")]
