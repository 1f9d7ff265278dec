"""What `snrmjax rom` writes: a model that reads back, load cases, a summary and a page."""

import json

import numpy as np
import pytest
from condense.conftest import basis_of, cases_of
from scipy import optimize
from truths.hidden_membrane import hidden_membrane
from truths.printed_page import unreadable

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.condense.load_set import LoadSet
from snrmjax.condense.reduction import ReductionSource, ShapeLines
from snrmjax.io.reduction.load_tables import read_load_tables, write_load_cases
from snrmjax.pipelines.reduce import reduce_model
from snrmjax.report.figures.reduction import (
    FURTHER,
    quality_figure,
    scale_figure,
    shapes_figure,
    static_figure,
)
from snrmjax.report.pages.reduction import write

WRITTEN = {
    *("model.toml", "load_cases.csv", "summary.json", "report.html"),
    *("force_displacement.png", "fit_quality.png"),
}


@pytest.fixture(scope="module")
def source():
    """Two modes whose load cases are run on demand, as finite elements would."""
    truth = hidden_membrane(2, 2, curved=3.0)
    basis = basis_of(truth, (1, 3))
    return truth, ReductionSource(
        name="panel",
        basis=basis,
        damping_ratio=np.array([0.01, 0.02]),
        sensors={"tip": np.asarray(basis.shapes)[0]},
        participation=np.array([1.0, 0.0]),  # the force does not drive the second mode
        solve=lambda force: cases_of(truth, LoadSet(force, ())),
        thickness=2.0,
        lines=ShapeLines(np.arange(4.0), np.asarray(basis.shapes)),
    )


@pytest.fixture(scope="module")
def found(source):
    return reduce_model(source[1])


def test_a_source_that_runs_its_cases_is_condensed_studied_and_written(source, found, tmp_path):
    truth, _ = source
    write(tmp_path, found)
    assert {p.name for p in tmp_path.iterdir()} == WRITTEN | {"load_scale.png", "mode_shapes.png"}
    model = sj.read_model(tmp_path / "model.toml")
    known = truth.coefficients()
    for monomial, value in zip(
        model.potential.monomials, np.asarray(model.potential.coefficient), strict=True
    ):
        assert value == pytest.approx(known[monomial], rel=1e-6)
    np.testing.assert_allclose(model.modes.natural_frequency, truth.frequency)
    assert abs(model.modes.participation[1]) < 1e-9
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["modes"] == [1, 3]
    assert summary["load_cases"]["load_scale"] == pytest.approx(found.displacement.max() / 2.0)
    assert summary["load_scale_study"]["scale_of_the_model_inside"] is True
    assert summary["load_scale_study"]["plateau_decades"] > 1
    assert summary["fit"]["energy_error"] < 1e-9
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img") == 4
    assert "mode 3" in page


def test_figures_are_readable_on_paper(source, found):
    _, of_truth = source
    names = found.mode_names
    sweep = found.sweep
    for figure in (
        shapes_figure(of_truth.lines, names),
        static_figure(found.condensation, names, sweep),
        quality_figure(found.condensation),
        scale_figure(found.study),
    ):
        assert unreadable(figure) == []
    assert found.study.plot().axes[0].get_title("left") == "Coefficients"
    # The reduced model of a polynomial truth holds as far as the sweep goes.
    first = static_figure(found.condensation, names, sweep).axes[0]
    assert len(found.condensation.plot().axes) == len(names)
    lines = {line.get_label(): line for line in first.lines}
    curve, dots = lines["reduced model"], lines[FURTHER]
    x, y = curve.get_data()
    solved = np.isfinite(x)
    on_curve = np.interp(dots.get_xdata(), x[solved], y[solved])
    inside = np.abs(dots.get_xdata()) <= np.nanmax(np.abs(x))
    np.testing.assert_allclose(on_curve[inside], dots.get_ydata()[inside], rtol=0.01)


def test_a_stated_load_scale_is_in_thicknesses(source):
    _, of_truth = source
    found = reduce_model(of_truth._replace(load_scale=0.5), study=False)
    np.testing.assert_array_equal(found.displacement, [1.0, 1.0])
    alone = found.condensation.cases.force[found.condensation.cases.names.index("+1 at 1")]
    basis = of_truth.basis
    assert alone[0] / basis.frequency[0] ** 2 * basis.largest[0] == pytest.approx(1.0)
    assert found.study is None


def softening(last=0.0):
    """One mode with the force ω²q + βq³/(1 + q²), whose cubic part ends at q of about one.

    Beyond a force of -`last` (0: none) another solution is found, as a solver that jumps would.
    """
    frequency, beta, force = np.array([2.0]), 3.0, lambda q: 4.0 * q + 3.0 * q**3 / (1 + q**2)
    basis = sj.condense.ReductionBasis(frequency, np.eye(1), np.eye(1), (1,))

    def solve(forces):
        rows = np.asarray(forces)
        q = np.array([[optimize.brentq(lambda x, f=f: force(x) - f, -1e3, 1e3)] for (f,) in rows])
        jumped = np.where((last > 0) & (rows < -last), -q, q)
        return sj.condense.StaticCases(rows, jumped, np.ones(len(q), bool))

    one = ReductionSource("spring", basis, np.array([0.01]), {"tip": np.ones(1)}, np.ones(1))
    return beta, one._replace(solve=solve, thickness=1.0)


@pytest.mark.parametrize("scale", [0.3, 0.5])
def test_a_scale_beyond_the_plateau_is_compared_with_the_chosen_one(scale):
    beta, spring = softening()
    found = reduce_model(spring._replace(load_scale=scale), study=False)
    (note,) = (n for n in found.notes if getattr(n, "kind", "") == "load_scale_compared")
    lost = note["change"]
    chosen = reduce_model(spring, study=False)
    cubic = [4 * float(one.structure.potential.coefficient[-1]) for one in (chosen, found)]
    # The chosen loads are small: their coefficient is the force's own third derivative, nearly.
    assert cubic[0] == pytest.approx(beta, rel=0.05)
    assert -0.5 < lost < -0.02
    assert lost == pytest.approx(cubic[1] / cubic[0] - 1)
    assert chosen.notes == ()


def test_a_scale_whose_model_is_none_of_the_structure_is_refused():
    _, spring = softening()
    with pytest.raises(ValueError, match=r"1111 differs by -\d+ % .* leave the key out"):
        reduce_model(spring._replace(load_scale=30.0), study=False)
    _, jumping = softening(last=4.0)
    with pytest.raises(ValueError, match=r"is \d+ % of the nonlinear force of its own load"):
        reduce_model(jumping._replace(load_scale=2.0), study=False)


def test_load_cases_that_were_written_condense_to_the_same_model(source, tmp_path, monkeypatch):
    truth, of_truth = source
    cases = cases_of(truth, sj.condense.modal_loads(of_truth.basis, 3.0))
    write_load_cases(tmp_path / "cases.csv", cases)
    hertz = [float(one) for one in truth.frequency / (2 * np.pi)]
    (tmp_path / "modes.toml").write_text(
        f"frequency_hz = {hertz}\ndamping_ratio = 0.01\nparticipation = 1.0\n"
        "[sensors]\ntip = [1.0, 2.0]\n"
    )
    np.testing.assert_array_equal(read_load_tables(tmp_path).cases.force, cases.force)
    out = tmp_path / "out"
    command = ["snrmjax", "rom", "--tables", str(tmp_path), "--out", str(out)]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert {p.name for p in out.iterdir()} == WRITTEN
    direct = sj.condense.reduced_model(of_truth.basis, cases)
    model = sj.read_model(out / "model.toml")
    np.testing.assert_allclose(
        model.potential.coefficient, direct.potential.coefficient, rtol=1e-10
    )
