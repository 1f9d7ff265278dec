"""What commands do, in Python in at most five lines, with the files that the command writes."""

import numpy as np
import pytest
from truths.one_mode import model, noisy, states, table

import snrmjax as sj


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verbs")
    level, w, f, v = states()
    sj.io.write_model(folder / "model.toml", model())
    sj.io.write_steady_states(folder / "measured.csv", table(level, w, f, noisy(v)))
    return folder


def written(result, out, **settings):
    sj.write_results(result, out, **settings)
    return {path.name for path in out.iterdir()}


def test_identification_obeys_or_refuses_every_option(files, tmp_path):
    given, data = str(files / "model.toml"), str(files / "measured.csv")
    model, data = sj.pipelines.read_test(data, given)
    found = sj.pipelines.identify_test(data, model, predict_force=(1.0,))
    assert {"points.csv", "backbone.csv", "prediction.csv", "summary.json", "report.html"} <= (
        written(found, tmp_path / "out", title="One")
    )
    assert found.resonances[0].force == 1.0
    for wrong, message in (
        ({"robust": True}, "`--robust` belongs to a joint fit"),
        ({"knots": 4, "fit": "auto"}, "`--knots` has no effect with `--fit`"),
        ({"extrapolate": 2.0}, "`--extrapolate` belongs to predictions"),
        ({"predict_force": (-1.0,)}, "`--predict-force` must be above zero, but is -1 N"),
        ({"predict_at": "tip"}, "`--predict-at` belongs to predictions under a force"),
        ({"predict_drive": (1.0,)}, "is for data with a drive voltage"),
    ):
        with pytest.raises(ValueError, match=message):
            sj.pipelines.identify_test(data, model, **wrong)


def test_check_and_import(files, tmp_path):
    found = sj.pipelines.check_files([str(files / "measured.csv")], str(files / "model.toml"))
    assert found.findings == ()
    assert written(found, tmp_path / "checked") == {"check.json"}
    imported = sj.pipelines.import_test([str(files / "measured.csv")], phase_sign="lag")
    data = sj.read_steady_states(files / "measured.csv")
    np.testing.assert_allclose(imported.states.velocity, np.conj(data.velocity))
    assert written(imported, tmp_path / "imported") == {"measured.csv", "map.toml"}


def test_simulation(files, tmp_path):
    given = sj.read_model(files / "model.toml")
    found = sj.pipelines.simulate_responses(given, [1.0], 55, 65)
    page = {"response.csv", "response.png", "summary.json", "report.html"}
    assert written(found, tmp_path / "out") == page
    # A linear structure's largest response: Φ² F / (2ζω).
    (curve,) = found.curves
    modes = given.modes
    peak = modes.mode_shape[0, 0] ** 2 / (2 * modes.damping_ratio[0] * modes.natural_frequency[0])
    assert np.abs(curve.velocity[:, 1, 0]).max() == pytest.approx(float(peak), rel=1e-3)
    # Both events of one curve, and of the second force too.
    found = sj.pipelines.simulate_responses(
        given, [1.0, 2.0], 55, 65, follow=["peak", "phase_resonance", "fold"], to=3.0
    )
    assert [note.kind for note in found.notes] == ["no_event_to_follow"]
    assert [events.kind for events in found.events] == ["peak", "phase_resonance"]
    # The second force is on the curve from the first.
    np.testing.assert_allclose([events.force.min() for events in found.events], 1.0)
    assert written(found, tmp_path / "events") == {
        *(*page, "events.csv", "events.png"),
    }
    damped = sj.pipelines.simulate_responses(
        *(given, [1.0, 2.0], 55, 65),
        follow=["peak"],
        parameter="mode_1.damping_ratio",
        to=2 * float(given.modes.damping_ratio[0]),
    )
    assert [events.force[0] for events in damped.events] == [1.0, 2.0]
    with pytest.raises(ValueError, match=r"`parameter` names .mode_9\.damping_ratio"):
        sj.pipelines.simulate_responses(
            given, [1.0], 55, 65, follow=["fold"], parameter="mode_9.damping_ratio", to=1.0
        )
    with pytest.raises(ValueError, match="`to` must be given"):
        sj.pipelines.simulate_responses(given, [1.0], 55, 65, follow=["fold"])
    with pytest.raises(ValueError, match="must be given with `follow`"):
        sj.pipelines.simulate_responses(given, [1.0], 55, 65, parameter="mode_1.damping_ratio")
    with pytest.raises(ValueError, match="must differ from the linear frequency"):
        sj.pipelines.simulate_mode(given, 60.0)


def test_a_mode_that_does_not_reach_the_frequency_asked_for_says_where_it_ends():
    modes = sj.model.linear_modes([1.0], [0.02], [[1.0]], [1.0])
    softening = sj.model.structure(modes, sj.model.polynomial_potential({"1111": -0.25}, 1))
    found = sj.pipelines.simulate_mode(softening, 0.3, harmonics=3)
    (note,) = [note for note in found.notes if note.kind == "mode_not_followed"]
    # q̈ + q − q³ = 0: its frequency falls to zero at the separatrix, below 1/(2π) everywhere.
    assert note["ends_hz"] == found.branch.frequency[-1] / (2 * np.pi) < 0.16
    assert note["to_hz"] == 0.3
    assert not [
        n
        for n in sj.pipelines.simulate_mode(softening, 0.15, harmonics=3).notes
        if n.kind == "mode_not_followed"
    ]


def test_only_results_of_pipelines_have_files(tmp_path):
    with pytest.raises(ValueError, match="a `dict` has no files"):
        sj.write_results({}, tmp_path)


def test_equilibria_that_are_further_are_counted_without_the_one_that_curves_start_from():
    def noted(potential, **effects):
        modes = sj.model.linear_modes([2.0], [0.02], [[1.0]], [1.0], sensors=["tip"])
        made = [sj.model.make_effect(kind, settings) for kind, settings in effects.items()]
        potential = sj.model.polynomial_potential(potential, 1)
        structure = sj.model.structure(modes, potential, effects=made)
        found = sj.pipelines.simulate_responses(structure, [1e-3], 0.05, 0.06, harmonics=1)
        return [str(note) for note in found.notes if note.kind == "further_equilibria"]

    # 4 q + q³ = 1 has one root, which is not zero.
    pressed = {"static_preload": {"constant_force": -1.0}}
    assert noted({"1111": 0.25}, **pressed) == []
    # 4 q − 3·2 q² + 2 q³ = 2 q (q − 1)(q − 2).
    (note,) = noted({"111": -2.0, "1111": 0.5})
    assert "2 further equilibria, at tip: unstable at 1e+03 mm and stable at 2e+03 mm" in note
    assert "Curves start from rest, and responses also from the stable ones" in note
    # 4 q + 1.25 q² = 1.25 q (q + 3.2).
    (note,) = noted({"111": 1.25 / 3})
    assert "one further equilibrium, at tip: unstable at -3.2e+03 mm." in note
    assert note.endswith("Curves start from rest.")
