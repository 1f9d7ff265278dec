"""The site's pages on validation: nothing typed in, no empty table, numbers found again."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import snrmjax as sj

SITE = Path(__file__).resolve().parents[1] / "notebooks" / "site"
PAGES = sorted((SITE / "pages" / "validation").glob("*.md"))
# What is no result: a level of confidence, numbers of figures and tables, ratios, years, files.
NO_RESULT = re.compile(
    r"\{\{.*?\}\}|\]\(.*?\)|`.*?`|95 %|[Ff]igures? \d+( to \d+)?|Table \d+|\b1:\d\b|\(20\d\d\)|−90°"
)


@pytest.fixture(scope="module")
def validation():
    sys.path.insert(0, str(SITE))
    try:
        yield importlib.import_module("validation")
    finally:
        sys.path.remove(str(SITE))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_no_number_of_its_own(page):
    typed = re.findall(r".*\d.*", NO_RESULT.sub("", page.read_text("utf-8")))
    assert not typed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_all_that_a_page_names_is_put_in(page, validation):
    text = validation.filled(page.read_text("utf-8"))
    assert "{{" not in text
    assert not re.search(r"\b(nan|None|inf)\b", text)
    for table in re.findall(r"(?:^\|.*\n?)+", text, re.M):
        cells = [line.count("|") for line in table.replace("\\|", "").splitlines()]
        assert len(cells) > 2
        assert len(set(cells)) == 1


def test_an_empty_table_or_an_unknown_name_is_an_error(validation):
    with pytest.raises(ValueError, match="is empty"):
        validation.tables.table(["a", "b"], [])
    with pytest.raises(ValueError, match="No result is called nothing of this name"):
        validation.filled("{{ nothing of this name }}")


def test_a_published_number_is_found_again(validation):
    # One term of the Duffing oscillator, in closed form: at a fold of its response Ω over the
    # amplitude has a largest or a smallest value.
    damping, cubic, force = 0.05, 0.1, 0.18

    def above(a):
        middle = 1 + 0.75 * cubic * a**2
        root = (force / a) ** 2 + damping**4 / 4 - damping**2 * middle
        return np.sqrt(middle - damping**2 / 2 + np.sqrt(root))

    near = {"xatol": 1e-10}
    lower = minimize_scalar(above, bounds=(0.5, 2.0), options=near).fun
    upper = -minimize_scalar(lambda a: -above(a), bounds=(2.0, 2.8416), options=near).fun
    spring = sj.model.make_effect("cubic_stiffness", {"coefficient": cubic}, at="x1")
    model = sj.model.from_matrices([[1.0]], [[damping]], [[1.0]], force="x1", effects=spring)
    (curve,) = sj.forced_response(model, force, 0.5, 1.6, harmonic_order=1, stability=False)
    ours = np.sort(curve.frequency[curve.at_events("fold")])
    np.testing.assert_allclose(ours, [lower, upper], rtol=1e-9)  # the tolerance of events
    page = validation.tables.problems()
    for fold in ours:
        # Seven digits of ours beside six of the source.
        assert re.search(rf"\| fold, H 1 \| {fold:.6g} \| {fold:.7g} \|", page)


def test_shares_have_the_intervals_of_a_binomial(validation):
    # Nothing or all of n: the tail is one power.
    n = 17
    assert validation.of.binomial(0, n) == pytest.approx((0, 1 - 0.025 ** (1 / n)))
    assert validation.of.binomial(n, n) == pytest.approx((0.025 ** (1 / n), 1))
    # Six of twenty, from tables of Clopper and Pearson's interval.
    assert validation.of.binomial(6, 20) == pytest.approx((0.1189, 0.5428), abs=5e-5)


def test_a_bar_is_met_or_missed(validation):
    met = validation.of._met
    assert met("0 of 30 (0.0 %)", "<= 2 %")
    assert not met("16 of 20 (80.0 %)", ">= 85 %")
    assert not met("7 of 12 (58.3 %)", "all")
    assert not met("1.50", "<= 1.3")
    assert met("0 of 0", ">= 95 %") is None


def test_rounded_numbers_are_the_same_or_not(validation):
    def agrees(published, found):
        return validation.of.Comparison("", "", published, found, 0.0, "printed").agrees

    assert agrees("15.59", "15.58961")
    assert not agrees("15.863", "15.86022")
    assert agrees("6.71e-08", "6.710499e-08")


def test_a_figure_is_the_same_at_every_run(validation):
    first, second = (validation.drawn(validation.FIGURES["figure_9"], "dark") for _ in range(2))
    assert first == second
    assert np.size(re.findall("<path", first)) > 20
