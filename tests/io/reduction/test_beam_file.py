"""Beams as TOML: contents, refusals, and the resulting models."""

import json
import re

import jax
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.condense.beam_parameters import beam_parameters, check_beam_name
from snrmjax.io.reduction.beam_file import (
    is_beam_file,
    read_beam,
    read_beam_description,
)

BEAM = """name = "flat beam"
[material]
young_pa = 204.8e9
density_kg_m3 = 7870.0
poisson = 0.29
[section]
width_m = 0.0127
thickness_m = 0.000508
[geometry]
length_m = 0.2286
elements = 12
[supports]
left = "clamped"
right = "clamped"
[condense]
modes = [1, 3]
[sensors]
midspan = 0.5
[force]
distribution = "uniform"
"""
MASS = "[[point_mass]]\nat = 0.5\nmass_kg = 1e-3\n"
MASS_KEYS = ("mass_kg", "inertia_kg_m2")
SPRINGS = "{ axial_n_m = 1e6, transverse_n_m = 1e7 }"


def supports_of(numbers):
    keys = ("axial_n_m", "transverse_n_m", "rotation_nm_rad")
    return [[numbers[f"supports.{side}.{key}"] for key in keys] for side in ("left", "right")]


def test_a_beam_file_gives_the_description(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(BEAM)
    beam = read_beam_description(path)
    numbers = dict(beam.numbers)
    assert supports_of(numbers) == [[np.inf] * 3] * 2
    assert (beam.name, numbers["material.young_pa"]) == ("flat beam", 204.8e9)
    assert numbers["section.thickness_m"] == 0.000508
    assert "geometry.radius_m" not in numbers
    assert (beam.load_scale, beam.force_at, beam.damping_ratio) == (None,) * 3
    assert (beam.modes, beam.degree, beam.sensors) == ((1, 3), 3, (("midspan", 0.5),))
    text = BEAM.replace("elements", "radius_m = 11.43\nelements").replace(
        'right = "clamped"', f"right = {SPRINGS}"
    )
    text = text.replace("3]", "3]\nload_scale = 0.3\ndegree = 5\ndamping_ratio = [0.05, 0.001]")
    text = text.replace("midspan = 0.5", "midspan = 0.5\nquarter = 0.25")
    text = text.replace('"clamped"', "{ axial_n_m = inf, rotation_nm_rad = 50 }")
    path.write_text(
        text.replace('distribution = "uniform"', "at = 0.25")
        + MASS
        + "inertia_kg_m2 = 2e-8\n"
        + MASS
    )
    beam = read_beam_description(path)
    numbers = dict(beam.numbers)
    assert supports_of(numbers) == [[np.inf, 0, 50], [1e6, 1e7, 0.0]]
    assert beam.masses_at == (0.5, 0.5)
    masses = [numbers[f"point_mass_{k}.{key}"] for k in (1, 2) for key in MASS_KEYS]
    assert masses == [1e-3, 2e-8, 1e-3, 0.0]
    assert beam.sensors == (("midspan", 0.5), ("quarter", 0.25))
    assert (numbers["geometry.radius_m"], beam.load_scale, beam.degree) == (11.43, 0.3, 5)
    assert (beam.force_at, beam.damping_ratio) == (0.25, (0.05, 0.001))


def edit(old, new):
    return BEAM.replace(old, new)


BAD_BEAMS = [
    (edit("thickness_m = 0.000508", "thickness_m = 0"), "`thickness_m` must be positive"),
    (edit("7870.0", "-7870.0"), "`density_kg_m3` must be positive, but [material]"),
    (edit("204.8e9", "nan"), "`young_pa` must be a finite number"),
    (edit("204.8e9", '"steel"'), "`young_pa` must be a number"),
    (edit("young_pa", "youngs_pa"), "unknown key 'youngs_pa' (did you mean `young_pa`?)"),
    (edit("0.29", "0.5"), "`poisson` must be above -1 and below 0.5"),
    (edit("[section]", "[sections]"), "unknown key 'sections' (did you mean `section`?)"),
    (edit("width_m = 0.0127\n", ""), "lacks the key `width_m`"),
    (edit("thickness_m = 0.000508", "thickness_m = 0.5"), "below the length"),
    (edit("0.2286", "-0.2286"), "`length_m` must be positive"),
    (edit("elements = 12", "elements = 1"), "`elements` must be a whole number from 2"),
    (edit("elements = 12", "elements = 12.5"), "`elements` must be a whole number"),
    (edit("elements = 12", "elements = 5000"), "at most 400"),
    (edit("elements", "radius_m = 0.1\nelements"), "`radius_m` must be above 0.1203"),
    (edit("elements", "rise_m = 0.2\nelements"), "`rise_m` must be below half of the length"),
    (edit("elements", "radius_m = 11\nrise_m = 0\nelements"), "both `radius_m` and `rise_m`"),
    (edit('left = "clamped"', 'left = "clammped"'), "did you mean `clamped`"),
    (edit('left = "clamped"\n', ""), "lacks the key `left`"),
    (edit('left = "clamped"', "left = { axial_nm = 1 }"), "unknown key 'axial_nm'"),
    (edit('left = "clamped"', "left = {}"), "a support or stiffnesses"),
    (edit('left = "clamped"', "left = { axial_n_m = -1 }"), "zero or positive"),
    (edit('"clamped"', '"free"'), "leave a mechanism: nothing fixes the beam along"),
    (
        edit('left = "clamped"', 'left = "free"').replace('"clamped"', '"pinned"'),
        "leave a mechanism: nothing prevents rotation of the beam",
    ),
    (edit("[1, 3]", "[1, 1]"), "different mode numbers"),
    (edit("[1, 3]", "[0]"), "`modes` must be a whole number from 1"),
    (edit("[1, 3]", "[]"), "at least one"),
    (edit("[1, 3]", "[1, 13]"), "12 elements can represent"),
    (edit("[1, 3]", "[1, 3]\ndegree = 9"), "`degree` must be from 2 to 7"),
    (edit("[1, 3]", "[1, 3]\nload_scale = 0"), "`load_scale` must be positive"),
    (edit("[1, 3]", "[1, 3]\ndamping_ratio = [0.1]"), "2 numbers, one a mode"),
    (edit("midspan = 0.5", "midspan = 1.5"), "`midspan` must be from 0 to 1"),
    (edit('"uniform"', '"unifrom"'), "did you mean `uniform`"),
    (edit("midspan = 0.5", "clamp = 0"), "`clamp` at 0, where no mode moves"),
    (edit('distribution = "uniform"', "at = 1.0"), "[force] of beam.toml is at 1, where no mode"),
    (edit('"clamped"', "{ axial_n_m = -inf }"), "`axial_n_m` must be a finite number"),
    (BEAM + MASS.replace("mass_kg", "mass"), "unknown key 'mass' (did you mean `mass_kg`?)"),
    (BEAM + MASS.replace("0.5", "114"), "`at` must be from 0 to 1, but point_mass 1 of beam.toml"),
    (
        BEAM + MASS + MASS.replace("1e-3", "-1e-3"),
        "zero or positive, but point_mass 2 of beam.toml",
    ),
    (BEAM + MASS.replace("mass_kg = 1e-3\n", ""), "point_mass 1 of beam.toml lacks the key"),
    (BEAM + MASS.replace("[[point_mass]]", "[point_mass]"), "tables under [[point_mass]]"),
    (BEAM + "at = 0.5\n", "both `distribution` and `at`"),
    ("material = [", "is not valid TOML"),
]


def refused(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["snrmjax", "rom", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    message = capsys.readouterr().err
    assert ended.value.code == 2
    assert message.partition("read more: ")[0].count("\n") == 1
    return message


@pytest.mark.parametrize(("text", "words"), BAD_BEAMS, ids=[words for _, words in BAD_BEAMS])
def test_a_bad_beam_is_refused_with_one_sentence(tmp_path, capsys, monkeypatch, text, words):
    path = tmp_path / "beam.toml"
    path.write_text(text)
    assert words in refused(monkeypatch, capsys, path, "--out", tmp_path / "out")
    assert {one.name for one in tmp_path.iterdir()} == {"beam.toml"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "needs one of BEAM, --tables and --calculix, but has none of them"),
        (["beam.toml", "--tables", "tables"], "but has BEAM and --tables"),
        (["beam.toml", "--modes", "1,3"], "`--modes` needs --calculix"),
        (["nowhere.toml"], "nowhere.toml does not exist"),
        (["--tables", "nowhere"], "nowhere does not exist"),
    ],
)
def test_one_source_is_needed(tmp_path, capsys, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(monkeypatch, capsys, *arguments, "--out", "out")
    assert not list(tmp_path.iterdir())


def test_a_beam_becomes_a_model_that_simulates(tmp_path, monkeypatch):
    path, out = tmp_path / "beam.toml", tmp_path / "out"
    path.write_text(BEAM.replace("[1, 3]", "[1]\ndamping_ratio = 0.05"))
    monkeypatch.setattr("sys.argv", ["snrmjax", "rom", str(path), "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    model = sj.read_model(out / "model.toml")
    # Closed forms of the clamped beam: k = 4.73004, shape 1.58815 and mean 0.83086 of √(1/mass).
    mass = 7870.0 * 0.0127 * 0.000508 * 0.2286
    speed = np.sqrt(204.8e9 * 0.000508**2 / 12 / 7870.0)
    natural = 4.730040745**2 * speed / 0.2286**2
    assert float(model.modes.natural_frequency[0]) == pytest.approx(natural, rel=1e-4)
    assert float(model.modes.mode_shape[0, 0]) == pytest.approx(1.58815 / mass**0.5, rel=1e-3)
    assert float(model.modes.participation[0]) == pytest.approx(0.83086 / mass**0.5, rel=1e-3)
    assert model.modes.sensors == ("midspan",)
    # V = EA/(8L) (∫φ'² dx)² q⁴ with ∫φ'² = 12.3026/(mass L).
    area = 0.0127 * 0.000508
    quartic = 204.8e9 * area / (8 * 0.2286) * (12.3026 / (mass * 0.2286)) ** 2
    assert float(model.potential.coefficient[1]) == pytest.approx(quartic, rel=2e-3)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["load_scale_study"]["scale_of_the_model_inside"] is True
    assert summary["load_scale_study"]["plateau_decades"] >= 1.0
    assert summary["notes"] == []


def test_assumed_damping_is_noted_and_a_force_may_be_at_a_point(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(edit("[1, 3]", "[1]").replace('distribution = "uniform"', "at = 0.5"))
    source = read_beam(path)
    np.testing.assert_allclose(source.participation, source.sensors["midspan"])
    np.testing.assert_array_equal(source.damping_ratio, [0.01])
    assert [note.kind for note in source.notes] == ["damping_assumed"]
    assert source.thickness == 0.000508
    middle = len(source.lines.position) // 2
    assert source.lines.position[middle] == pytest.approx(0.2286 / 2)
    np.testing.assert_allclose(source.lines.shape[middle], source.sensors["midspan"])


def test_a_heavy_point_mass_swings_on_the_static_stiffness_of_the_beam(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(edit("[1, 3]", "[1]") + MASS.replace("1e-3", "1.0"))
    source = read_beam(path)
    bending = 204.8e9 * 0.0127 * 0.000508**3 / 12
    # 192 EI/L³ at midspan of a clamped beam; 13/35 of its 11.6 g move with it, 0.43 % of 1 kg.
    assert float(source.basis.frequency[0]) == pytest.approx(
        np.sqrt(192 * bending / 0.2286**3 / 1.0043), rel=1e-3
    )
    assert float(source.sensors["midspan"][0]) == pytest.approx(1.0, rel=3e-3)  # 1/√kg


def test_a_beam_file_is_distinguished_from_a_model_file(tmp_path):
    for text, expected in (
        (BEAM, True),
        ("[material]\n", True),
        ("[[mode]]\n", False),
        ("", False),
    ):
        (tmp_path / "one.toml").write_text(text)
        assert is_beam_file(tmp_path / "one.toml") is expected


def test_models_of_a_beam_are_functions_of_its_numbers(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(edit("[1, 3]", "[1, 3]\nload_scale = 0.3"))
    models = sj.io.read_beam_models(path)
    thin, thick = (models({"section.thickness_m": h}) for h in (0.0004, 0.0005))
    frequency = [float(m.modes.natural_frequency[0]) for m in (thin, thick)]
    cubic = [sj.model.parameter_values(m)["potential.1111"] for m in (thin, thick)]
    # A clamped beam: frequency ∝ h except for shear and rotary inertia, (h/L)²; cubic coefficient
    # E φ⁴/(ρ² A L⁵) ∝ 1/h: load cases in thicknesses have the same truncation error.
    assert frequency[1] / frequency[0] == pytest.approx(1.25, rel=3e-5)
    assert cubic[1] / cubic[0] == pytest.approx(0.8, rel=1e-4)
    damped = models({"mode_2.damping_ratio": 0.04, "force_n": 3.0})
    np.testing.assert_allclose(damped.modes.damping_ratio, [0.01, 0.04])

    def backbone_frequency(values):
        model = models(values)
        return sj.simulate.normal_mode_at_velocities(model, 0.1, harmonic_order=3).frequency[0]

    # The whole chain can be traced and differentiated; a long test checks the values.
    start = {"section.thickness_m": 5e-4, "geometry.rise_m": 3e-4}
    slope = jax.eval_shape(lambda one: jax.jvp(backbone_frequency, (one,), (one,))[1], start)
    assert slope.shape == ()
    for values, words in (
        ({"section.thickness": 1e-3}, "did you mean `section.thickness_m`"),
        ({"section.thickness_m": 0.5}, "is not below the length"),
        ({"geometry.rise_m": 0.2}, "a rise of 0.2 m is too large"),
    ):
        with pytest.raises(ValueError, match=words):
            models(values)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("section.thicknes_m", "did you mean `section.thickness_m`?"),
        ("thickness_m", "did you mean `section.thickness_m`?"),
        ("mode_1.dampin_ratio", "did you mean `mode_1.damping_ratio`?"),
        ("geometry.radius_m", "vary geometry.rise_m, or state a radius"),
        ("supports.left.rotation_nm_rad", "state one, such as left = { rotation_nm_rad = 1e6 }"),
        ("anything", "it has material.young_pa"),
    ],
)
def test_a_name_that_no_beam_has_is_refused(tmp_path, name, words):
    path = tmp_path / "beam.toml"
    path.write_text(BEAM + MASS)
    beam = read_beam_description(path)
    with pytest.raises(ValueError, match=re.escape(words)):
        check_beam_name(beam, name, "beam.toml", ("mode_1.damping_ratio",))


def test_the_numbers_of_a_beam_are_those_of_its_file(tmp_path):
    path = tmp_path / "beam.toml"
    text = edit("elements", "rise_m = 1e-3\nelements").replace(
        'left = "clamped"', "left = { axial_n_m = inf, transverse_n_m = inf, rotation_nm_rad = 7 }"
    )
    path.write_text(text + MASS)
    assert beam_parameters(read_beam_description(path)) == {
        "material.young_pa": 204.8e9,
        "material.density_kg_m3": 7870.0,
        "material.poisson": 0.29,
        "section.width_m": 0.0127,
        "section.thickness_m": 0.000508,
        "geometry.length_m": 0.2286,
        "geometry.rise_m": 1e-3,
        "supports.left.rotation_nm_rad": 7.0,
        "point_mass_1.mass_kg": 1e-3,
        "point_mass_1.inertia_kg_m2": 0.0,
    }
