"""Wrong or ambiguous input: exit 2, one sentence with the option needed, nothing written."""

import gzip
import re

import numpy as np
import pytest
import scipy.io
from truths.import_runs import run_import as run
from truths.uff_writing import write_uff

from snrmjax.measure import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses

TABLE = "f,F,v,ph\n79,0.1,1,10\n80,0.1,2,20\n81,0.1,1,200\n"
STATED = "--force F --force-unit N --response v:velocity:m/s"
OVER = "--force-amplitude 1 --response a:velocity:m/s"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("raw")
    files = {
        "t.csv": TABLE,
        "rad.csv": TABLE.replace("200", "2").replace("10\n", "1\n").replace("20\n", "2\n"),
        "two.csv": TABLE.replace("ph\n", "phase 2\n").replace("f,F,", "f,freq2,"),
        "units.csv": TABLE.replace("f,F,v", "f (Hz),F (N),v (mm/s)"),
        "sizes.csv": TABLE.replace("f,F,v", "f (Hz),F (N),v (mm/s rms)"),
        "omega.csv": TABLE.replace("f,", "omega,", 1),
        "negative.csv": TABLE.replace(",2,", ",-2,"),
        "noforce.csv": TABLE.replace("80,0.1", "80,0"),
        "zero.csv": "f,F,v,ph\n79,0.1,0,10\n80,0.1,0,200\n",
        "part.csv": "f,F,v,ph\n79,0.1,1\n",
        "bad.toml": "forse = 'F'\n",
        "worse.toml": "phase_unit = 'grad'\n",
        "no.toml": "x = ",
    }
    for name, text in files.items():
        (path / name).write_text(text)
    (path / "t.csv.gz").write_bytes(gzip.compress(TABLE.encode()))
    t = np.arange(400) / 1000
    noise = np.random.default_rng(0).normal(size=(2, 400))
    scipy.io.savemat(path / "record.mat", {"fs": 1000.0, "a": noise[0], "b": noise[1]})
    scipy.io.savemat(path / "mixed.mat", {"fs": 1e3, "a": t, "d": {"freq": t[:9], "F": t[:9]}})
    one = frequency_responses(
        np.array([500.0, 510.0]), np.ones((1, 1, 2)) + 0j, [Channel("a")], [Channel("b")]
    )
    write_uff(path / "frf.uff", responses=[one, one])
    return path


@pytest.mark.parametrize(
    ("words", "question"),
    [
        ("none.csv " + STATED, "does not exist"),
        ("t.csv.gz " + STATED, "gzip archive: unpack"),
        ("part.csv " + STATED, "--frequency names it, of column_1"),
        ("part.csv " + STATED, "--frequency-start and --frequency-step"),
        ("t.csv --force F", "--response COLUMN:velocity"),
        ("t.csv --response v:velocity:m/s", "--force COLUMN"),
        ("t.csv --force G --response v:velocity:m/s", "has the columns f, F, v, ph"),
        ("t.csv --force G --force-unit N --response v:velocity:m/s", "has the columns f, F, v, ph"),
        ("t.csv --force F --response v:velocity:m/s", "--force-unit N"),
        ("t.csv --force F --force-unit m --response v:velocity:m/s", "--force names another"),
        ("t.csv --force F --force-unit N --response v:velocity", "--response v:velocity:m/s"),
        ("t.csv --force F --force-unit N --response v:velocity:g", "which of both is right"),
        ("t.csv --force F --force-unit N --response v:velocity:qq", "not understood"),
        ("t.csv --force F --force-unit N --response v:speed", "--response must be"),
        ("t.csv --force F --force-unit N --response w:velocity:m/s", "has the columns"),
        ("rad.csv " + STATED, "--phase-unit deg or rad"),
        ("two.csv --force v --force-unit N --response v:velocity:m/s", "--frequency names it"),
        ("sizes.csv --force F --response v", "--amplitude peak, rms"),
        ("sizes.csv --force F --response v --amplitude peak", "which is right"),
        ("omega.csv " + STATED, "--frequency-unit Hz or rad/s"),
        ("negative.csv " + STATED, "--imaginary COLUMN"),
        ("noforce.csv " + STATED, "must be above zero, but row 2"),
        ("zero.csv " + STATED, "only zero"),
        ("t.csv " + STATED + " --level nothing", "--level must be"),
        ("t.csv " + STATED + " --phase-unit grad", "--phase-unit must be one of deg, rad"),
        ("t.csv " + STATED + " --sensor a --sensor b", "--sensor must be given once for each"),
        ("t.csv " + STATED + " --response v:velocity:m/s", "names 'v' twice"),
        ("t.csv --map bad.toml", "unknown key 'forse'.*did you mean `force`"),
        ("t.csv --map worse.toml", "phase_unit"),
        ("t.csv --map no.toml", "not valid TOML"),
        ("t.csv --map none.toml", "does not exist"),
        ("mixed.mat --force F --force-unit N --response v", "--dataset names it"),
        ("record.mat --response a:velocity:m/s", "--force CHANNEL"),
        ("record.mat --force a --force-unit N --response b:velocity:m/s", "--record steps, sweep"),
        ("record.mat --force a --force-unit N --response b", "--response b:velocity:m/s"),
        ("frf.uff --response a:velocity:m/s", "--force-amplitude .*one a set .2."),
        ("frf.uff " + OVER + " --force-amplitude 1 --force-amplitude 1", "3 are stated"),
        ("frf.uff --force-amplitude -1 --response a:velocity:m/s", "must be a positive number"),
        ("frf.uff --force-amplitude z --response a:velocity:m/s", "needs positive values"),
        ("t.csv " + STATED + " --header-row 2", "row 2 of t.csv has numbers"),
        ("t.csv " + STATED + " --record steps", "--record has no effect on a table"),
        ("t.csv " + STATED + " --dataset b", "names 'b', but t.csv has t"),
        (
            "t.csv " + STATED + " --force-amplitude 2",
            "--force-amplitude has no effect together with",
        ),
        (
            "t.csv " + STATED + " --base v:velocity:m/s",
            "--force has no effect together with --base",
        ),
        (
            "t.csv " + STATED + " --force-phase ph --over-force",
            "--force-phase has no effect together with",
        ),
        ("t.csv " + STATED + " --imaginary ph --phase-unit deg", "--phase-unit has no effect"),
        ("t.csv " + STATED + " --imaginary ph --phase ph", "--phase ph has no effect"),
        (
            "t.csv --force v --force-unit N --response v:velocity:m/s",
            "both as the response and as the excitation",
        ),
        (
            "t.csv --force-amplitude 2 --force-unit banana --response v:velocity:m/s",
            "not understood",
        ),
        ("t.csv --force-amplitude 2 --force-unit g --response v:velocity:m/s", "--base the motion"),
        ("t.csv --force-amplitude name --response v:velocity:m/s", "must state one amplitude"),
        ("t.csv --base F --response v:velocity:m/s", "--base must state its quantity"),
        ("t.csv --base -1:acceleration:g --response v:velocity:m/s", "--base must be above zero"),
        ("t.csv --base F:acceleration --response v:velocity:m/s", "--base F:acceleration:m/s"),
        (
            "record.mat --base a:acceleration:g --response a:velocity:m/s",
            "as the response and as the excitation",
        ),
        ("record.mat --base 1:acceleration:g --response b:velocity:m/s", "must name the channel"),
        (
            "record.mat " + STATED.replace("F", "a").replace("v:", "b:") + " --decimal comma",
            "whose format is fixed",
        ),
    ],
)
def test_what_is_wrong_or_unclear_is_asked_for(tmp_path, folder, words, question, monkeypatch):
    monkeypatch.chdir(folder)
    code, output = run(*words.split(), "--out", tmp_path / "out")
    assert code == 2, output
    assert "\n" not in output.strip()

    assert re.search(question, output), output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "answer", "repeated"),
    [
        (
            "t.csv --force F --force-unit V --over-force --response v:velocity:m/s/N",
            "the divisor of --over-force is in V, which is no unit of force",
            "give --over-force",
        ),
        (
            "t.csv --force F --force-unit N --response v --unit N",
            "unit N is of force: give the motion that the number 1 means",
            "--unit states",
        ),
        (
            "t.csv --frequency-unit deg " + STATED,
            "--frequency-unit is Hz or rad/s",
            "--frequency names",
        ),
        (
            "t.csv --force-amplitude z --response v:velocity:m/s",
            "--force-amplitude must be one number for t.csv, .*, but is z",
            "which column",
        ),
        (
            "t.csv --force-amplitude 1 --force-amplitude 2 --response v:velocity:m/s",
            "--force-amplitude must be one number for t.csv, .*, but is 1.*,2",
            "which column",
        ),
        (
            "t.csv --base 1,2:acceleration:g --response v:velocity:m/s",
            "--base must be one number for t.csv, .*, but is 1.*,2",
            "which column",
        ),
        (
            "spectra.uff --force a --force-unit N --response b:velocity:m/s",
            r"a of spectra.uff has 2 references \(c, d\): .* or name a reference by --force",
            "which reference",
        ),
    ],
)
def test_advice_does_not_repeat_an_option_that_is_given(folder, words, answer, repeated, tmp_path):
    spectra = frequency_responses(
        np.array([500.0, 510.0]),
        np.ones((2, 2, 2)) + 0j,
        [Channel("a"), Channel("b")],
        [Channel("c"), Channel("d")],
    )
    write_uff(folder / "spectra.uff", responses=[spectra])
    name, *options = words.split()
    code, output = run(folder / name, *options, "--out", tmp_path / "out")
    assert code == 2
    assert re.search(answer, output), output
    assert repeated not in output


def test_channels_without_a_folder_are_asked_for_one(folder):
    code, output = run(folder / "t.csv", *STATED.split())
    assert code == 2
    assert "--out DIR" in output
