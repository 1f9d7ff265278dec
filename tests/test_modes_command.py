"""The command `modes` as a user runs it: files of a laboratory in, a model and a report out."""

import io
import sys
from contextlib import redirect_stderr
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from truths.modal_structures import HERTZ, chain, integrated, receptance
from truths.uff_writing import write_uff

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.recordings.time_recording import time_recording
from snrmjax.pipelines.modes import find_linear_modes

RATIOS = [0.01, 0.008, 0.006]
STRUCTURE = chain([1.0, 1.2, 0.8], [8e4, 9e4, 1.1e5], RATIOS)
HEAVIER = chain([1.0, 1.25, 0.8], [8e4, 9e4, 1.1e5], RATIOS)
SHAPES = STRUCTURE.shapes * np.sign(STRUCTURE.shapes[0])
LINES = np.arange(8, 120, 0.5) * HERTZ
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def run(*arguments):
    """A command in this process: its exit code and what it said."""
    with (
        redirect_stderr(io.StringIO()) as stderr,
        mock.patch.object(sys, "argv", ["snrmjax", "modes", *map(str, arguments)]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return ended.value.code or 0, stderr.getvalue()


def accelerance(structure=STRUCTURE, points="123", **more):
    force = Channel("F1", "force", "N", point="1", direction="+z")
    sensors = [
        Channel(f"A{k + 1}", "acceleration", "m/s^2", point=p, direction="+z")
        for k, p in enumerate(points)
    ]
    rng = np.random.default_rng(0)
    values = -(LINES**2) * receptance(structure, LINES, 0)
    noise = 1e-3 * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    made = more.pop("values", values + noise)
    return frequency_responses(LINES, made[:, None], sensors, [force], **more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of a laboratory."""
    path = tmp_path_factory.mktemp("laboratory")
    write_uff(path / "frf.uff", responses=[accelerance()])
    write_uff(path / "heavier.uff", responses=[accelerance(HEAVIER)])
    write_uff(path / "elsewhere.uff", responses=[accelerance(points="456")])
    good = accelerance()
    write_uff(path / "conjugated.uff", responses=[accelerance(values=good.values[:, 0].conj())])
    force = [Channel("F1", "force", "N", point="1", direction="+z")]
    both = [*force, Channel("F2", "force", "N", point="2", direction="+z")]
    pair = np.concatenate([good.values, good.values], axis=1)
    write_uff(path / "two.uff", responses=[frequency_responses(LINES, pair, good.responses, both)])
    line = frequency_responses(LINES[:4], good.values[:, :, :4], good.responses, force)
    write_uff(path / "line.uff", responses=[line])
    short = frequency_responses(LINES[2:], good.values[:, :, 2:], good.responses, force)
    write_uff(path / "short.uff", responses=[short])
    start = np.concatenate([np.zeros(3), np.linalg.inv(STRUCTURE.mass)[0]])
    velocity = integrated(STRUCTURE, np.zeros((1024, 3)), 512.0, start=start)[1].T
    rows = [f"{k / 5120:.3f},{v!r}" for k, v in enumerate(velocity[0, :300].tolist())]
    (path / "open_rate.csv").write_text("\n".join(["time [s],v [m/s]", *rows]))
    channels = [Channel(f"V{k}", "velocity", "m/s", point=str(k), direction="+z") for k in "123"]
    write_uff(path / "decay.uff", recordings=[time_recording(velocity, channels, 512.0)])
    pushed = [Channel("F", "force", "N", point="1", direction="+z"), *channels[1:]]
    write_uff(path / "pushed.uff", recordings=[time_recording(velocity, pushed, 512.0)])
    return path


def test_responses_become_a_model_and_a_report(folder, tmp_path):
    out = tmp_path / "new" / "model.toml"
    code, said = run(folder / "frf.uff", "--interest", 2, "--out", out)
    assert code == 0, said
    modes = sj.read_model(out).modes
    assert modes.mode_of_interest == 1
    assert np.allclose(modes.natural_frequency, STRUCTURE.natural_frequency, rtol=2e-4)
    assert np.allclose(modes.damping_ratio, RATIOS, rtol=0.02)
    assert np.allclose(modes.mode_shape, SHAPES, rtol=0.02, atol=2e-3)
    assert np.allclose(modes.participation, SHAPES[0], rtol=0.02)
    assert np.all(modes.natural_frequency_std > 0)
    assert np.all((modes.modal_mass_std > 0) & (modes.modal_mass_std < 0.02))
    report = (out.parent / "report.html").read_text(encoding="utf-8")
    assert "Poles over the model order" in report or "Poles of every model order" in report
    assert "phase collinearity" in report
    table = (out.parent / "modes.csv").read_text(encoding="utf-8").splitlines()
    assert table[0].startswith("mode,sensor,frequency_hz,frequency_std_hz")
    assert len(table) == 1 + 3 * 3


def test_conjugated_responses_give_the_modes_of_the_others(folder, tmp_path):
    found = []
    for words in (("frf.uff",), ("conjugated.uff", "--conjugated")):
        out = tmp_path / f"{len(found)}.toml"
        assert run(folder / words[0], *words[1:], "--out", out)[0] == 0
        found.append(sj.read_model(out).modes)
    for name in ("natural_frequency", "damping_ratio", "mode_shape", "participation"):
        one, other = (np.asarray(getattr(modes, name)) for modes in found)
        assert np.allclose(one, other, rtol=1e-6)  # of what UFF's digits leave


@pytest.mark.long
def test_an_added_mass(folder, tmp_path):
    out = tmp_path / "model.toml"
    scale = ("--added-mass", 0.05, "--with-mass", folder / "heavier.uff")
    names = [
        c.name
        for c in sj.io.laboratory.read_laboratory_file(folder / "frf.uff").responses[0].responses
    ]
    code, said = run(folder / "elsewhere.uff", *scale, "--mass-at", "nowhere", "--out", out)
    assert code == 2
    assert "there is no sensor 'nowhere'" in said
    code, said = run(folder / "frf.uff", *scale, "--mass-at", names[1], "--out", out)
    assert code == 0, said
    modes = sj.read_model(out).modes
    assert np.allclose(np.abs(modes.mode_shape), np.abs(SHAPES), rtol=0.02, atol=5e-3)


def test_a_decay_gives_frequency_and_damping(folder, tmp_path):
    out = tmp_path / "model.toml"
    code, said = run(folder / "decay.uff", "--unscaled", "--highest-order", 10, "--out", out)
    assert code == 0, said
    modes = sj.read_model(out).modes
    assert np.allclose(modes.natural_frequency, STRUCTURE.natural_frequency, rtol=1e-4)
    assert np.allclose(modes.damping_ratio, RATIOS, rtol=1e-3)
    assert "not mass-normalised" in said


@pytest.mark.parametrize(
    "base", [pytest.param(False, id="force"), pytest.param(True, id="base", marks=pytest.mark.long)]
)
def test_shape_times_participation_is_the_residue_without_a_scale(base, tmp_path):
    """Two modes at two sensors, residues of either sign: the model has the response itself."""
    omega, ratio = np.array([20.0, 24.0]) * HERTZ, np.array([0.004, 0.003])
    residue = np.array([[-0.8, 0.5], [0.3, 0.2]])  # 1/kg, sensor by mode; 1 over a base
    at = np.linspace(18, 26, 161) * HERTZ
    poles = omega**2 - at[:, None] ** 2 + 2j * ratio * omega * at[:, None]
    relative = 1j * at[:, None] * ((1 / poles) @ residue.T)
    known = {"sensors": ("tip", "root"), "phase_std": np.full((len(at), 2), 1e-4)}
    one, level = np.ones(len(at)), np.ones(len(at), dtype=int)
    if base:
        recorded = relative + 1 / (1j * at[:, None])
        std = 1e-4 * np.abs(recorded)
        data = sj.measure.base_excited_states(level, at, one, recorded, velocity_std=std, **known)
    else:
        std = 1e-4 * np.abs(relative)
        data = sj.measure.steady_states(level, at, one, relative, velocity_std=std, **known)
    sj.io.write_steady_states(tmp_path / "s.csv", data)
    out = tmp_path / "model.toml"
    words = ("--base", "absolute") if base else ()
    code, said = run(tmp_path / "s.csv", "--unscaled", *words, "--out", out)
    assert code == 0, said
    modes = sj.read_model(out).modes
    assert np.allclose(modes.mode_shape * modes.participation, residue, rtol=1e-3)
    assert np.all(modes.participation < 0 if base else modes.participation > 0)
    again = sj.io.read_steady_states(tmp_path / "s.csv", modes)
    points = sj.identify_backbone(again, sj.read_model(out)).points
    solved = np.asarray(points.natural_frequency)[np.asarray(points.status) == 0]
    assert solved.size > 0
    assert np.allclose(solved, omega[0], rtol=1e-3)


BAD = [
    (("elsewhere.uff",), "no sensor is known to be where"),
    (("conjugated.uff",), "seem to be conjugated, of e^(-iΩt): state `--conjugated`"),
    (("frf.uff", "--conjugated"), "seem to be conjugated, of e^(-iΩt): leave `--conjugated` out"),
    (("decay.uff", "--conjugated"), "no effect on modes from records"),
    (("decay.uff", "--rate", "600"), "--rate states 600 Hz, but decay.uff 512 Hz"),
    (("frf.uff", "--rate", "512"), "no effect on modes from frequency responses"),
    (("open_rate.csv",), "`--rate 5120`, or state another"),
    (("two.uff",), "over one reference, but there are 2"),
    (("line.uff",), "modes need 6 lines"),
    (("frf.uff", "frf.uff"), "comes 2 times"),
    (("frf.uff", "short.uff"), "must share their frequencies"),
    (("frf.uff", "decay.uff"), "of one kind"),
    (("missing.uff",), "does not exist"),
    (("pushed.uff",), "time records with a force"),
    (("decay.uff", "--highest-order", "6"), "a free decay has no force"),
    (("frf.uff", "--poles", "21,x"), "--poles must be frequencies"),
    (("frf.uff", "--poles", "500"), "a pole must lie in the band"),
    (("frf.uff", "--from-hz", "300"), "modes need 6 lines"),
    (("frf.uff", "--interest", "7"), "mode of interest must be from 1 to 3"),
    (("frf.uff", "--drive-point", "tip"), "there is no sensor 'tip'"),
    (("frf.uff", "--turned"), "are negative"),
    (("frf.uff", "--reference", "tip"), "there is no reference 'tip'"),
    (("frf.uff", "--sensor-mass", "tip"), "as tip=0.2"),
    (("frf.uff", "--fixture-mass", "2"), "needs the masses at the sensors"),
    (("frf.uff", "--added-mass", "0.1"), "needs its mass in kg"),
    (("frf.uff", "--unscaled", "--known-shape", "tip=2"), "one scale of the shapes"),
    (("frf.uff", "--free"), "low residual"),
    (("frf.uff", "--base", "both"), "must be 'absolute' or 'relative'"),
    (("frf.uff", "--base", "relative"), "needs one reference that is a displacement"),
]


@pytest.mark.parametrize(("words", "wanted"), BAD, ids=[f"{k} {b[1]}" for k, b in enumerate(BAD)])
def test_wrong_input_ends_with_one_sentence(folder, tmp_path, words, wanted):
    out = tmp_path / "out" / "model.toml"
    code, said = run(
        *(folder / word if word.endswith((".uff", ".csv")) else word for word in words),
        "--out",
        out,
    )
    assert code == 2
    assert wanted in said
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert not out.parent.exists()


def test_the_model_must_be_a_toml(folder, tmp_path):
    code, said = run(folder / "frf.uff", "--out", tmp_path / "results")
    assert code == 2
    assert "must be a model to write (.toml)" in said


@pytest.mark.skipif(not SHARED.exists(), reason="measured data are not beside the project")
def test_the_measured_beam_has_the_modes_that_its_source_states(tmp_path):
    beam = SHARED / "brake_reuss_beam"
    out = tmp_path / "model.toml"
    code, said = run(beam / "response_controlled.csv", "--drive-point", "sensor 1", "--out", out)
    assert code == 0, said
    found, stated = sj.read_model(out).modes, sj.read_model(beam / "model.toml").modes
    # The source states 80.37 ± 0.05 Hz, 0.15 ± 0.02 %, 1.89 kg.
    spread = np.hypot(found.natural_frequency_std, stated.natural_frequency_std)
    assert abs(found.natural_frequency - stated.natural_frequency)[0] < 2 * spread[0]
    spread = np.hypot(found.damping_ratio_std, stated.damping_ratio_std)
    assert abs(found.damping_ratio - stated.damping_ratio)[0] < 2 * spread[0]
    mass = 1 / float(found.mode_shape[0, 0] * found.participation[0])
    assert mass == pytest.approx(1.89, rel=0.01)
    assert "depends on the amplitude" in said


@pytest.mark.parametrize(
    ("sources", "option", "said"),
    [
        ("responses", {"level": 2}, "`--level` has no effect on modes from frequency responses"),
        ("decays", {"window": "hann"}, "`--window` has no effect on modes from records"),
        ("decays", {"base": "absolute"}, "`--base` has no effect on modes from records"),
        ("responses", {"mass_at": "tip"}, "`--mass-at` belongs to an added mass"),
        ("responses", {"newtons_per_volt_std": 0.1}, "belongs to a calibration"),
        ("responses", {"turned": True, "unscaled": True}, "no effect with `--unscaled`"),
    ],
)
def test_options_that_nothing_obeys_are_refused(sources, option, said):
    given = {
        "decays": (),
        "responses": frequency_responses(
            np.array([500.0, 510.0]), np.ones((1, 1, 2)) + 0j, [Channel("tip")], [Channel("force")]
        ),
    }[sources]
    with pytest.raises(ValueError, match=said):
        find_linear_modes(given, **option)
