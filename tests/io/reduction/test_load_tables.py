"""Folders of load-case tables: all ways to give the same cases, and what is refused."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.io.reduction.load_tables import read_load_tables


def coefficients(folder):
    source = read_load_tables(folder.path)
    reduced = sj.condense.reduced_model(source.basis, source.cases)
    return reduced.potential


def check(folder, rtol=1e-7):
    potential, known = coefficients(folder), folder.truth.coefficients()
    expected = [known[m] for m in potential.monomials]
    np.testing.assert_allclose(potential.coefficient, expected, rtol=rtol)


def test_nodal_displacements_and_a_mass_matrix_give_the_known_potential(folder):
    source = read_load_tables(folder.path)
    assert source.name == "panel"
    assert source.basis.numbers == (1, 3)
    np.testing.assert_allclose(source.basis.frequency, folder.truth.frequency)
    np.testing.assert_allclose(
        source.cases.modal_displacement, folder.cases.modal_displacement, atol=1e-9
    )
    np.testing.assert_array_equal(source.cases.energy, folder.cases.energy)
    np.testing.assert_array_equal(source.sensors["tip"], [0.5, -0.25])
    np.testing.assert_array_equal(source.damping_ratio, [0.02, 0.02])
    np.testing.assert_array_equal(source.participation, [1.0, 2.0])
    assert source.notes == ()
    check(folder)


def test_modal_displacements_give_the_same(folder):
    force, q = np.asarray(folder.cases.force), np.asarray(folder.cases.modal_displacement)
    folder.write("cases.csv", case=list(folder.cases.names), f=force, q=q)
    check(folder)
    folder.replace("modes.toml", 'shapes = "shapes.csv"\nmass = "mass.csv"\n', "")
    check(folder)


def test_without_mass_the_modes_are_fitted_to_the_written_displacements(folder):
    # The pseudo-inverse is exact where the remaining displacement is orthogonal to the shapes.
    rotation, _ = np.linalg.qr(folder.truth.map)
    u = np.asarray(folder.cases.displacement) @ np.linalg.inv(folder.truth.map).T @ rotation.T
    folder.replace("modes.toml", 'mass = "mass.csv"\n', "")
    folder.write("shapes.csv", shape=rotation[:, :2])
    folder.write("cases.csv", case=list(folder.cases.names), f=np.asarray(folder.cases.force), u=u)
    check(folder)


def test_what_is_not_stated_is_assumed_with_a_note(folder):
    folder.replace("modes.toml", "[sensors]\ntip = [0.5, -0.25]\n", "")
    folder.replace("modes.toml", "participation = [1.0, 2.0]\n", "")
    folder.replace("modes.toml", "damping_ratio = 0.02\n", "")
    source = read_load_tables(folder.path)
    row = int(np.argmax(np.abs(folder.truth.shapes[:, 0])))
    assert list(source.sensors) == [f"dof {row + 1}"]
    np.testing.assert_array_equal(source.participation, folder.truth.shapes[row])
    assert len(source.notes) == 3


def test_empty_displacements_mark_a_case_without_solution(folder):
    rows = folder.load_rows()
    fields = rows[3].split(",")
    rows[3] = ",".join([*fields[:3], *[""] * 5])
    (folder.path / "cases.csv").write_text("\n".join(rows) + "\n")
    source = read_load_tables(folder.path)
    assert np.flatnonzero(~source.cases.usable).tolist() == [2]


def edit(name, old, new):
    return lambda folder: folder.replace(name, old, new)


def scaled(row, columns, factor):
    """One case's fields multiplied."""

    def change(folder):
        rows = folder.load_rows()
        fields = rows[row].split(",")
        for k in columns:
            fields[k] = repr(float(fields[k]) * factor)
        rows[row] = ",".join(fields)
        (folder.path / "cases.csv").write_text("\n".join(rows) + "\n")

    return change


def every(factor):
    def change(folder):
        for row in range(1, len(folder.load_rows())):
            scaled(row, range(3, 7), factor)(folder)

    return change


def kept(count):
    def change(folder):
        rows = folder.load_rows()[: count + 1]
        (folder.path / "cases.csv").write_text("\n".join(rows) + "\n")

    return change


def twice(folder):
    rows = folder.load_rows()
    (folder.path / "cases.csv").write_text("\n".join([*rows, rows[1]]) + "\n")


def still(folder):
    rows = [row.split(",") for row in folder.load_rows()]
    rows[1:] = [[row[0], row[1], "0.0", *row[3:]] for row in rows[1:]]
    (folder.path / "cases.csv").write_text("\n".join(map(",".join, rows)) + "\n")


def unsolved(folder):
    rows = [row.split(",") for row in folder.load_rows()]
    rows[1:] = [[*row[:3], *[""] * 5] for row in rows[1:]]
    (folder.path / "cases.csv").write_text("\n".join(map(",".join, rows)) + "\n")


def other_shape(factor, mix=0.0):
    def change(folder):
        shapes = np.array(folder.truth.shapes)
        shapes[:, 1] = factor * shapes[:, 1] + mix * shapes[:, 0]
        folder.write("shapes.csv", shape=shapes)

    return change


BAD_TABLES = [
    (lambda folder: (folder.path / "modes.toml").unlink(), "modes.toml does not exist"),
    (lambda folder: (folder.path / "cases.csv").unlink(), "cases.csv does not exist"),
    (lambda folder: (folder.path / "mass.csv").unlink(), "mass.csv does not exist"),
    (edit("modes.toml", "frequency_hz", "frequencies_hz"), "unknown key 'frequencies_hz' (did"),
    (edit("modes.toml", "frequency_hz = [", "frequency_hz = [-"), "must be positive"),
    (edit("modes.toml", "[1, 3]", "[1, 1]"), "`numbers` must be different mode numbers"),
    (edit("modes.toml", "0.02", "1.5"), "from 0 to below 1"),
    (edit("modes.toml", "[0.5, -0.25]", "[0.5]"), "2 numbers, one a mode"),
    (edit("modes.toml", 'shapes = "shapes.csv"\n', ""), "has a `mass`, but no `shapes`"),
    (other_shape(0.5), "not mass-normalised: ΦᵀMΦ of mode 3 is 0.25"),
    (other_shape(1.0, 0.1), "not orthogonal: ΦᵀMΦ of modes 1 and 3 is 0.1"),
    (lambda folder: folder.write("shapes.csv", shape=np.eye(4)), "4 shapes for the 2 modes"),
    (lambda folder: folder.write("mass.csv", mass=np.ones(3)), "shape (3,), but shapes.csv has 4"),
    (edit("cases.csv", "u_2", "u_3"), "the column `u_3` twice"),
    (edit("cases.csv", "u_2", "v_2"), "unknown column 'v_2'"),
    (edit("cases.csv", "u_1,u_2,u_3,u_4", "u_1,u_2,u_3,u_5"), "lacks the column `u_4`"),
    (edit("cases.csv", "f_1,f_2", "q_1,q_2"), "cases.csv has no `f_1 …`"),
    (
        edit("cases.csv", "+1 at 0.5,", "+1 at 0.5,x"),
        "`f_1` must be a number, but row 2 of cases.csv",
    ),
    (twice, "the case '+1 at 0.5' twice"),
    (kept(0), "no rows below it"),
    (kept(3), "3 usable load cases give 6 equations for 9"),
    (scaled(5, range(3, 7), -1.0), "other load cases: +1 +2 at 0.5 (displaced against the force"),
    (scaled(2, range(3, 7), 1e3), "wrong unit"),
    (every(1e3), "are inconsistent"),
    (edit("cases.csv", "u_1,u_2,u_3,u_4", "a,b,c,d"), "unknown column 'a'"),
    (lambda folder: folder.write("cases.csv", f=np.ones((2, 3)), q=np.ones((2, 2))), "has 3 modes"),
    (lambda folder: folder.write("cases.csv", f=np.ones((2, 2)), u=np.ones((2, 3))), "has 3 degr"),
    (lambda folder: folder.write("cases.csv", f=np.ones((2, 2))), "no `q_1 …` or `u_1 …`"),
    (still, "the force of mode 3 is zero in every load case"),
    (unsolved, "none of the 16 load cases has a solution"),
]


@pytest.mark.parametrize(("change", "words"), BAD_TABLES, ids=[words for _, words in BAD_TABLES])
def test_bad_tables_are_refused_with_one_sentence(folder, capsys, monkeypatch, change, words):
    change(folder)
    out = folder.path.parent / "out"
    command = ["snrmjax", "rom", "--tables", str(folder.path), "--out", str(out)]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    message = capsys.readouterr().err
    assert ended.value.code == 2
    assert words in message
    assert message.partition("read more: ")[0].count("\n") == 1
    assert not out.exists()
