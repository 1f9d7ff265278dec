"""Study files: their content, and refusals with one sentence and no output."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.numerics.units import HERTZ
from snrmjax.study.variations import LogNormal, Uniform

MODEL = """
[[mode]]
frequency_hz = 50.0
damping_ratio = 0.02
shape = { tip = 2.0 }
participation = 3.0
[potential]
"1111" = 1e6
[[effect]]
kind = "coulomb_friction"
force = 0.01
"""
HEAD = """name = "peaks"
model = "model.toml"
compute = "peaks"
forces_n = [0.5]
from_hz = 40
to_hz = 60
seed = 7
"""
VARY = """[[vary]]
parameter = "mode_1.damping_ratio"
range = [0.01, 0.03]
points = 3
"""
SAMPLE = '[sample]\nmethod = "sobol"\nmembers = 8\n'
NORMAL = '[[vary]]\nparameter = "mode_1.damping_ratio"\ndistribution = "normal"\n'
JOINT = """[[vary]]
parameters = ["mode_1.damping_ratio", "potential.1111"]
mean = [0.02, 1e6]
covariance = [[1e-6, 0.0], [0.0, {variance}]]
"""
HERTZ_FOR_RAD_S = """[[vary]]
parameter = "mode_1.natural_frequency"
range = [49, 51]
points = 3
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.toml").write_text(MODEL)
    return tmp_path


def written(folder, text):
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_a_study_file_gives_the_study(folder):
    text = HEAD + "sensor = 'tip'\nharmonics = 3\ngrid_points = 11\nmembers_a_chunk = 5\n" + VARY
    text += '[[vary]]\nparameter = "coulomb_friction.force"\ndistribution = "lognormal"\n'
    text += "mean = 0.02\nstd = 0.01\n" + SAMPLE
    study = sj.study.read_study(written(folder, text))
    assert study.name == "peaks"
    assert (study.seed, study.n_members, study.n_chunks) == (7, 8, 2)
    assert study.names == ("mode_1.damping_ratio", "coulomb_friction.force")
    assert [type(one) for one in study.variations] == [Uniform, LogNormal]
    within = study.computation.within
    assert within.ends == pytest.approx((40 * HERTZ, 60 * HERTZ))
    assert within.harmonic_order == 3
    np.testing.assert_array_equal(study.computation.forces.values, [0.5])
    assert study.computation.grid_points == 11
    assert study.sensor == "tip"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lacks the key `compute`"),
        (HEAD.replace('"peaks"\nforces', '"peak"\nforces'), "did you mean `peaks`"),
        (HEAD.replace("from_hz = 40", "from_hertz = 40") + VARY, "from_hertz"),
        (HEAD.replace("from_hz = 40", "from_hz = 70") + VARY, "`from_hz` must be below"),
        (HEAD.replace("to_hz = 60\n", "") + VARY, "lacks the key `to_hz`"),
        (HEAD.replace("[0.5]", "[0.5, -1]") + VARY, "must be positive"),
        (HEAD.replace("[0.5]", "[0.5, 0.5]") + VARY, "different forces"),
        (HEAD.replace("forces_n = [0.5]\n", "") + VARY, "lacks the key `forces_n`"),
        (HEAD.replace('"model.toml"', '"beam.toml"') + VARY, "beam.toml does not exist"),
        (HEAD.replace("seed = 7", "seed = -7") + VARY, "`seed` must be a whole number"),
        (HEAD.replace("seed = 7", 'seed = "x"') + VARY, "`seed` must be a whole number"),
        (HEAD + "harmonics = 0\n" + VARY, "`harmonics` must be a whole number from 1"),
        (HEAD + "[[vary]]\nvalues = [1]\n", "vary 1 of study.toml lacks the key `parameter`"),
        (HEAD + VARY.replace("damping_ratio", "damping"), "mode_1.damping_ratio"),
        (HEAD + VARY + VARY, "mode_1.damping_ratio varies twice"),
        (
            HEAD + VARY.replace("[0.01, 0.03]", "[0.03, 0.03]"),
            "error: vary 1 of study.toml cannot be read: the range of",
        ),
        (HEAD + VARY.replace("[0.01, 0.03]", "[0.03, 0.01]"), "must rise"),
        (HEAD + VARY.replace("[0.01, 0.03]", "[0.01]"), "two numbers"),
        (HEAD + VARY.replace("0.01", "nan"), "finite"),
        (HEAD + VARY.replace("0.01,", "-0.01,"), "from 0 to below 1"),
        (HEAD + VARY + "values = [0.1]\n", "`values` and `range`"),
        (
            HEAD + VARY.replace("range = [0.01, 0.03]\npoints = 3", "values = []"),
            "at least one number",
        ),
        (HEAD + VARY.replace("points = 3", "points = 1"), "`points`"),
        (HEAD + VARY.replace("\npoints = 3", ""), "needs `members`"),
        (HEAD + NORMAL + "mean = 0.02\nstd = 0.001\n[sample]\nmethod = 'grid'\n", "has a distr"),
        (
            HEAD + NORMAL + "mean = 0.02\nstd = -0.01\n" + SAMPLE,
            "vary 1 of study.toml cannot be read: `std` of",
        ),
        (HEAD + NORMAL + "mean = 0.02\nstd = 0.05\n" + SAMPLE, "from 0 to below 1, but member"),
        (HEAD + NORMAL + "mean = 0.02\n" + SAMPLE, "lacks the key `std`"),
        (HEAD + NORMAL + "mean = 0.02\nstd = 0.001\n", "needs `members`"),
        (HEAD + NORMAL.replace('"normal"', '"gauss"') + SAMPLE, "`distribution` must be one of"),
        (HEAD + JOINT.format(variance=-1.0) + SAMPLE, "variance of potential.1111"),
        (HEAD + JOINT.format(variance="1.0, 2.0") + SAMPLE, "2 rows of 2 numbers"),
        (HEAD + JOINT.format(variance=1.0).replace("0.0]", "5.0]") + SAMPLE, "symmetric"),
        (
            HEAD + JOINT.format(variance=1.0).replace("0.0]", "5.0]").replace("[0.0", "[5.0"),
            "semidefinite",
        ),
        (
            HEAD
            + VARY.replace("= 3", "= 1000000")
            + VARY.replace("mode_1.damping_ratio", "potential.1111").replace("= 3", "= 1000000"),
            "1e+12",
        ),
        (HEAD + VARY + SAMPLE.replace("8", "0"), "`members` must be a whole number from 1"),
        (HEAD + VARY + SAMPLE.replace("sobol", "sobool"), "did you mean `sobol`"),
        (HEAD + VARY.replace("mode_1.damping_ratio", "force_n"), "`forces_n` is given too"),
        (
            HEAD + HERTZ_FOR_RAD_S,
            "is in rad/s, 314.159 in the model",
        ),
        (HEAD + "data = 3\n" + VARY, "unknown key 'data'"),
        (HEAD + 'sensor = "tipp"\n' + VARY, "the sensor 'tipp' (did you mean `tip`?)."),
        ("compute = [", "is not valid TOML"),
    ],
)
def test_a_bad_study_is_refused_before_anything_is_written(
    folder, capsys, monkeypatch, text, words
):
    path, before = written(folder, text), {"model.toml", "study.toml"}
    command = ["snrmjax", "study", "run", str(path), "--out", str(folder / "s.zarr")]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    printed = capsys.readouterr().err
    assert ended.value.code == 2
    assert words in printed
    assert printed.partition("read more: ")[0].count("\n") == 1
    assert {p.name for p in folder.iterdir()} == before
