"""Studies whose members have models of their own, most of them condensed from a beam file."""

from typing import ClassVar

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.numerics.units import HERTZ
from snrmjax.study.computations.base import MEMBER, AbstractComputation, Output
from snrmjax.study.store import description, differences

from .conftest import InThisProcess

# Elements and modes as in tests/io/reduction, so that compiled programs serve both.
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
load_scale = 0.3
"""
STUDY = """model = "beam.toml"
compute = "nnm"
to_hz = 70
harmonics = 3
"""
THICKNESS = '[[vary]]\nparameter = "section.thickness_m"\nvalues = [0.0004, 0.0005]\n'
YOUNG = '[[vary]]\nparameter = "material.young_pa"\nvalues = [2.0e11]\n'


def cubic_of(model):
    return sj.model.parameter_values(model).get("potential.1111", 0.0)


class Frequencies(AbstractComputation):
    """The first natural frequency, and as many points as its model has modes."""

    kind: ClassVar[str] = "frequencies"
    members_a_chunk: ClassVar[int] = 8
    driven: ClassVar[bool] = False

    def outputs(self):
        return {
            "status": Output((MEMBER,), "text", "", "status"),
            "frequency": Output((MEMBER,), "f8", "Hz", "frequency"),
            "cubic": Output((MEMBER,), "f8", "SI", "coefficient"),
            "n_points": Output((MEMBER,), "i4", "1", "points"),
            "point_damping": Output(("point",), "f8", "1", "damping of each mode"),
        }

    def rows(self, members):
        models = members.models
        return {
            "status": np.array(["solved"] * len(models)),
            "frequency": np.array([m.modes.natural_frequency[0] / HERTZ for m in models]),
            "cubic": np.array([cubic_of(m) for m in models]),
            "n_points": np.array([m.n_modes for m in models], "i4"),
            "point_damping": np.concatenate([m.modes.damping_ratio for m in models]),
        }


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "beam.toml").write_text(BEAM)
    return tmp_path


def read(folder, text):
    (folder / "study.toml").write_text(text)
    return sj.study.read_study(folder / "study.toml")


def command(monkeypatch, code, *arguments):
    monkeypatch.setattr("sys.argv", ["snrmjax", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == code


def test_a_member_without_a_model_is_a_row(linear_model, tmp_path):
    def model_of(values):
        if values["size"] < 0:
            raise ValueError(f"no model is of size {values['size']:g}.")
        return linear_model

    varied = (sj.study.Discrete("size", [-1.0, 2.0, -3.0, 4.0]),)
    study = sj.study.Study("own", linear_model, Frequencies(), varied, model_of=model_of)
    run = sj.study.run_study(study, tmp_path / "s.zarr", workers=InThisProcess().workers)
    data = run.open()
    refused = [f"refused: no model is of size {size}." for size in (-1, -3)]
    assert data.status.values.tolist() == [refused[0], "solved", refused[1], "solved"]
    assert run.failed == 2
    # The model is made in tests/study/conftest.py.
    np.testing.assert_allclose(data.frequency, [np.nan, 50.0, np.nan, 50.0])
    assert data.n_points.values.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(data.point_damping, [0.02, 0.02])


@pytest.mark.long
def test_members_are_beams_of_their_own_and_one_that_is_none_is_a_row(folder):
    study = read(folder, STUDY + THICKNESS)
    # In addition to two thicknesses an arch that snaps through in the load cases, and a damping.
    varied = (
        sj.study.Discrete("section.thickness_m", [0.0004, 0.0004, 0.0005]),
        sj.study.Discrete("geometry.rise_m", [0.0, 0.2, 0.0]),
        sj.study.Discrete("mode_2.damping_ratio", [0.02, 0.03, 0.04]),
    )
    study = sj.study.Study(
        "beams",
        study.model,
        Frequencies(),
        varied,
        sj.study.Sampling("list"),
        model_of=study.model_of,
    )
    workers = InThisProcess().workers
    data = sj.study.run_study(study, folder / "s.zarr", workers=workers).open()
    first, arch, second = data.status.values.tolist()
    assert (first, second) == ("solved", "solved")
    assert arch.startswith("refused: a rise of 0.2 m is too large for a length of 0.2286 m")
    # A clamped beam: frequency by its thickness, cubic coefficient by one over it (E φ⁴ / ρ² A L⁵).
    hertz, cubic = data.frequency.values, data.cubic.values
    assert hertz[2] / hertz[0] == pytest.approx(1.25, rel=3e-5)  # shear, rotary inertia: (h/L)²
    assert cubic[2] / cubic[0] == pytest.approx(0.8, rel=1e-4)  # terms beyond the cubic: load scale
    # Euler-Bernoulli: 4.73004² h/L² √(E/12ρ); elements 1e-5, shear and rotary inertia (h/L)².
    whole = 4.730041**2 * 0.0004 / 0.2286**2 * np.sqrt(204.8e9 / 12 / 7870) / HERTZ
    assert hertz[0] == pytest.approx(whole, rel=5e-5)
    assert np.isnan(hertz[1])
    assert data.n_points.values.tolist() == [2, 0, 2]
    np.testing.assert_allclose(data.point_damping, [0.01, 0.02, 0.01, 0.04])
    assert (
        sj.study.run_study(study, folder / "s.zarr", workers=workers).computed == 0
    )  # it is there


@pytest.mark.long
def test_a_study_of_a_beam_is_known_by_the_beam(folder):
    one = description(read(folder, STUDY + THICKNESS))
    assert differences(one, description(read(folder, STUDY + THICKNESS))) == {}
    (folder / "beam.toml").write_text(BEAM.replace("204.8e9", "200e9"))
    other = description(read(folder, STUDY + THICKNESS))
    assert list(differences(one, other)) == ["model_of.numbers.material.young_pa"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("vary", "words"),
    [
        (THICKNESS.replace("thickness_m", "thicknes_m"), "did you mean `section.thickness_m`?"),
        (THICKNESS.replace("section.thickness_m", "thickness_m"), "mean `section.thickness_m`?"),
        (THICKNESS.replace("section.thickness_m", "mode_1.dampin_ratio"), "mode_1.damping_ratio"),
        (THICKNESS.replace("section.thickness_m", "geometry.radius_m"), "vary geometry.rise_m"),
        (
            THICKNESS.replace("section.thickness_m", "supports.left.rotation_nm_rad"),
            "it is fixed there; to vary its stiffness state one, such as left = { rotation_nm_rad",
        ),
        (THICKNESS.replace("0.0005", "0.5"), "must be below the length (0.2286), but member 1"),
        (THICKNESS.replace("0.0005", "-0.5"), "section.thickness_m must be positive, but member 1"),
        (THICKNESS + THICKNESS, "section.thickness_m varies twice"),
    ],
)
def test_what_no_beam_has_is_refused(folder, vary, words, capsys, monkeypatch):
    (folder / "study.toml").write_text(STUDY + vary)
    command(monkeypatch, 2, "study", "run", folder / "study.toml", "--out", folder / "s")
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(p.name for p in folder.iterdir()) == ["beam.toml", "study.toml"]


@pytest.mark.long
@pytest.mark.parametrize("compute", ["peaks", "curves", "nnm"])
def test_a_study_by_the_command_line(folder, compute, monkeypatch):
    """Each kind over a geometry, a modulus and a force; the report; a member is that of `rom`."""
    text = STUDY.replace("nnm", compute)
    if compute != "nnm":
        text = text.replace("to_hz = 70", "from_hz = 30\nto_hz = 70\n")
        text += '[[vary]]\nparameter = "force_n"\nvalues = [0.005, 0.01]\n'
    text += '[sample]\nmethod = "grid"\n' + THICKNESS + YOUNG
    (folder / "study.toml").write_text(text)
    out = folder / "s.zarr"
    command(monkeypatch, 0, "study", "run", folder / "study.toml", "--out", out)
    command(monkeypatch, 0, "study", "report", out, "--out", folder / "report")
    data = sj.study.open_study(out)
    assert set(data.status.values.tolist()) == {"upper_end"}
    beam = BEAM.replace("0.000508", "0.0004").replace("204.8e9", "200e9")
    (folder / "one.toml").write_text(beam)
    command(monkeypatch, 0, "rom", folder / "one.toml", "--out", folder / "one", "--no-study")
    model = sj.read_model(folder / "one" / "model.toml")
    if compute == "nnm":
        alone = sj.nonlinear_normal_mode(model, 70 * HERTZ, harmonic_order=3)
        assert data.end_velocity_m_s[0] == pytest.approx(abs(alone.velocity[-1, 1, 0]), rel=1e-6)
        return
    (curve,) = sj.forced_response(model, [0.005], 30 * HERTZ, 70 * HERTZ, harmonic_order=3)
    peak = np.max(np.abs(curve.velocity[curve.at_events("peak"), 1, 0]))
    # Both located to rounding; a model file has all digits.
    assert float(data.peak_velocity_m_s[0]) == pytest.approx(peak, rel=1e-6)
