"""Model files with matrices and with effects at points: read, refused, written."""

import struct

import jax
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import snrmjax as sj
from snrmjax.io.models import read_model, write_model
from snrmjax.io.results import write_response

TEXT = """
[structure]
points = ["a", "b"]
mass = [[1.0, 0.0], [0.0, 0.05]]
stiffness = [[1.0453, -0.0453], [-0.0453, 0.0453]]
damping = [[0.015, -0.013], [-0.013, 0.013]]
[force]
at = "a"
[[effect]]
kind = "cubic_stiffness"
at = "a"
coefficient = 1.0
[[effect]]
kind = "one_sided_stop"
between = ["b", "a"]
stiffness = 100.0
gap = 1.0
"""


@pytest.fixture
def read(tmp_path):
    def read(text):
        (tmp_path / "two.toml").write_text(text)
        return read_model(tmp_path / "two.toml")

    return read


def same(one, other):
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in leaves)


def test_a_file_gives_the_same_structure_as_the_arrays(read):
    model = read(TEXT)
    assert model.name == "two"
    assert model.modes.sensors == ("a", "b")
    mass, stiffness = np.diag([1.0, 0.05]), np.array([[1.0453, -0.0453], [-0.0453, 0.0453]])
    shapes = np.asarray(model.modes.mode_shape)
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(2), atol=1e-12)
    squared = np.diag(np.asarray(model.modes.natural_frequency) ** 2)
    np.testing.assert_allclose(shapes.T @ stiffness @ shapes, squared, atol=1e-12)
    assert [e.at for e in model.effects] == [(("a", 1.0),), (("b", 1.0), ("a", -1.0))]


@pytest.mark.parametrize("suffix", ["npz", "mat"])
def test_matrices_in_files(read, tmp_path, suffix):
    inline = read(TEXT)
    arrays = {
        "mass": np.diag([1.0, 0.05]),
        "stiffness": np.array([[1.0453, -0.0453], [-0.0453, 0.0453]]),
        "damping": np.array([[0.015, -0.013], [-0.013, 0.013]]),
    }
    if suffix == "npz":
        np.savez(tmp_path / "m.npz", **arrays, points=np.array(["a", "b"]))
    else:
        cells = np.array(["a", "b"], dtype=object)
        scipy.io.savemat(tmp_path / "m.mat", {**arrays, "points": cells})
    rest = TEXT[TEXT.index("[force]") :]
    assert same(read(f'[structure]\nfile = "m.{suffix}"\n{rest}'), inline)


def test_what_is_written_reads_back(read, tmp_path):
    text = TEXT.replace(
        'at = "a"\n[[', "at = { a = 1.0, b = { amplitude = 0.5, phase_deg = 90 } }\n[[", 1
    )
    model = read(text + '[sensors]\npoints = ["b"]\n')
    assert (model.modes.sensors, model.modes.points) == (("b",), ("a",))
    assert model.modes.participation_lag is not None
    write_model(tmp_path / "back.toml", model)
    back = read_model(tmp_path / "back.toml")
    assert same(back, model)
    assert [e.at for e in back.effects] == [e.at for e in model.effects]
    assert (back.modes.sensors, back.modes.points) == (("b",), ("a",))


def test_effects_at_the_sensors_of_modes(read):
    modes = """
[[mode]]
frequency_hz = 10.0
damping_ratio = 0.01
participation = 1.0
shape = { tip = 1.0, root = 0.2 }
[[effect]]
kind = "jenkins_slider"
between = ["tip", "root"]
stiffness = 5.0
slip_displacement = 0.1
"""
    model = read(modes)
    q = jax.numpy.asarray(np.cos(2 * np.pi * np.arange(16) / 16)[:, None])
    force = np.asarray(model.nonlinear_force(q, q))
    assert abs(force[4, 0]) == pytest.approx(5 * 0.1 * 0.8, rel=1e-9)  # slips in between
    with pytest.raises(ValueError, match=r"effect 1 of two\.toml.*'tipp'.*did you mean `tip`"):
        read(modes.replace('["tip", "root"]', '["tipp", "root"]'))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('points = ["a", "b"]\n', "", "lacks the key `points`"),
        ('points = ["a", "b"]', 'points = ["a", "a"]', "names 'a' twice"),
        ('points = ["a", "b"]', 'points = ["a"]', "1 points, but there are 2"),
        ('points = ["a", "b"]', "points = 2", "list of names"),
        ("mass = [[1.0, 0.0], [0.0, 0.05]]", "mass = [[1.0, 0.0], [0.0]]", "rows of numbers"),
        ("mass = [[1.0, 0.0], [0.0, 0.05]]", "mass = [1.0, 0.05]", "rows of numbers"),
        ("mass = [[1.0, 0.0], [0.0, 0.05]]", 'mass = [["a", 0.0], [0.0, 1]]', "rows of numbers"),
        ("[0.0, 0.05]", "[0.0, -0.05]", "`mass` must be positive definite"),
        ("[-0.0453, 0.0453]", "[-0.1, 0.0453]", "`stiffness` must be symmetric"),
        ("[0.0, 0.05]", "[0.0, inf]", "must be finite"),
        ("[structure]", "[structure]\ndamping_ratio = 0.01", "both `damping` and `damping_ratio`"),
        ("[structure]", "[structure]\nfile = 'm.npz'", "both `file` and `mass`"),
        ("[structure]", "[structure]\nmodes = 0", "whole number from 1"),
        ("[structure]", "[structure]\nmodes = 9", "between 1 and 2"),
        ("[structure]", "mode_of_interest = 3\n[structure]", "from 1 to the number of modes"),
        ("[structure]", "[structure]\nmasse = 1", "unknown key 'masse'.*did you mean"),
        ("[structure]", '[potential]\n"1111" = 1.0\n[structure]', r"both \[structure\] and"),
        ('[force]\nat = "a"\n', "", "lacks the key `at`"),
        ('[force]\nat = "a"', '[force]\nat = "c"', "'c', which does not exist"),
        ('[force]\nat = "a"', "[force]\nat = {}", "a point, or points"),
        ('[force]\nat = "a"', "[force]\nat = { a = 0.0 }", "other than zero"),
        (
            '[force]\nat = "a"',
            "[force]\nat = { a = { phase_deg = 3 } }",
            "lacks the key `amplitude`",
        ),
        ('between = ["b", "a"]', 'between = ["b", "b"]', "two different points"),
        ('between = ["b", "a"]', 'between = ["b"]', "two points"),
        ('between = ["b", "a"]', 'between = ["b", "a"]\nat = "a"', "both `at` and `between`"),
        ('between = ["b", "a"]', 'between = ["b", "c"]', "'c', which does not exist"),
        ('between = ["b", "a"]', "at = { b = 0 }", "must be a number"),
        ('between = ["b", "a"]', "at = {}", "at least one point"),
        (
            "[force]",
            '[sensors]\npoints = ["q"]\n[force]',
            r"in \[sensors\] of two.toml names the point 'q'",
        ),
        ("[force]", '[sensors]\npoints = ["a", "a"]\n[force]', "different names"),
        ("[force]", "[sensors]\npoints = []\n[force]", "at least one"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(read, check_message, old, new, complaint):
    assert old in TEXT
    with pytest.raises(ValueError, match=complaint) as error:
        read(TEXT.replace(old, new, 1))
    check_message(error, ["two.toml"])


@pytest.mark.parametrize(
    ("file", "complaint"),
    [("none.npz", "file next to"), ("m.xls", r"an \.npz or \.mat"), ("bad.npz", "cannot be read")],
)
def test_files_without_matrices_are_refused(read, tmp_path, check_message, file, complaint):
    for name in ("m.xls", "bad.npz"):
        (tmp_path / name).write_text("nothing")
    with pytest.raises(ValueError, match=complaint) as error:
        read(f'[structure]\nfile = "{file}"\n[force]\nat = "a"\n')
    check_message(error, ["two.toml"])


@pytest.mark.parametrize("damage", ["sides", "type", "rows", "checksum"])
def test_damaged_matlab_files_are_refused(read, tmp_path, check_message, damage):
    """Three of them crashed scipy, or the process when a matrix was used."""
    arrays = {"mass": np.diag([1.0, 0.05]), "stiffness": scipy.sparse.csc_array(np.diag([1.0, 2]))}
    path = tmp_path / "bad.mat"
    is_packed = damage == "checksum"
    scipy.io.savemat(path, {**arrays, "points": ["a", "b"]}, do_compression=is_packed)
    content = bytearray(path.read_bytes())
    if damage == "sides":
        at = content.index(struct.pack("<IIII", 4, 0, 5, 8)) + 12
        content[at : at + 4] = bytes(4)
    elif damage == "type":
        at = content.index(arrays["mass"].tobytes()) - 8
        content[at] = 11
    elif damage == "rows":
        rows = struct.pack("<IIii", 5, 8, 0, 1)
        at = content.index(rows) + 12
        content[at : at + 4] = struct.pack("<i", 2**30)
    else:
        content[-9] ^= 1
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"bad\.mat.* cannot be read: it is damaged or not an MAT file"
    ) as error:
        read('[structure]\nfile = "bad.mat"\n[force]\nat = "a"\n')
    check_message(error, ["two.toml"])


def test_a_response_has_columns_for_every_sensor(tmp_path, read):
    curves = sj.forced_response(read(TEXT.split("[[effect]]")[0]), 0.1, 0.8, 0.9, harmonic_order=1)
    write_response(tmp_path / "response.csv", curves, sensor="b")
    table = np.genfromtxt(tmp_path / "response.csv", delimiter=",", names=True, dtype=None)
    wanted = curves[0].velocity[:, 1]
    for index, name in enumerate("ab"):
        velocity = table[f"velocity_h1_{name}_re_m_s"] + 1j * table[f"velocity_h1_{name}_im_m_s"]
        np.testing.assert_allclose(velocity, wanted[:, index], rtol=1e-10)
    np.testing.assert_array_equal(table["velocity_h1_re_m_s"], table["velocity_h1_b_re_m_s"])
