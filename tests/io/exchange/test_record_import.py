"""Time records of MATLAB and TDMS files to steady states: slow sweeps and steps."""

import functools
import itertools

import numpy as np
import pytest
import scipy.io
from nptdms import ChannelObject, TdmsWriter
from scipy.signal import cont2discrete, lfilter
from truths.import_runs import run_import as run

from snrmjax.io import read_steady_states
from snrmjax.io.exchange.import_map import read_import_map

HERTZ = 2 * np.pi
REST, RATIO = HERTZ * 10.0, 0.02  # rad/s, 1: an oscillator of 1 kg
RATE, SECONDS = 200.0, 60.0
POUND, GRAVITY = 4.4482216152605, 9.80665


def mobility(omega):
    """Mobility of the oscillator in steady state, m/(s N)."""
    return 1j * omega / (REST**2 - omega**2 + 2j * RATIO * REST * omega)


@functools.cache
def sweeps():
    """Force and acceleration of an upward sweep of 40 N and a downward one of 20 N.

    Exact except for the first-order hold at 64 times the rate: (ω/12.8 kHz)²/12, some 2e-6.
    """
    fine = 64
    time = np.arange(round(SECONDS * RATE) * fine) / (RATE * fine)
    above, below, _ = cont2discrete(
        ([1.0, 0, 0], [1.0, 2 * RATIO * REST, REST**2]), 1 / (RATE * fine), method="foh"
    )
    runs = []
    for first, last, force in ((8.5, 12.0, 40.0), (12.0, 8.5, 20.0)):
        phase = HERTZ * (first * time + (last - first) / (2 * SECONDS) * time**2)
        push = force * np.cos(phase)
        runs.append(np.stack([push, lfilter(above.ravel(), below, push)])[:, ::fine])
    return np.concatenate(runs, axis=1)


def as_matlab(path, force, acceleration):
    scipy.io.savemat(path, {"fs": RATE, "load": force / POUND, "acc": acceleration / GRAVITY})
    return "load", "acc:acceleration:g", "lbf"


def as_tdms(path, force, acceleration):
    """Sixteen bits with the scales of a DAQ, in segments of uneven length."""
    kept = []
    for values, unit in ((force / POUND, "lbf"), (acceleration / GRAVITY, "g")):
        slope = np.abs(values).max() / 32767
        scale = {
            "NI_Number_Of_Scales": 1,
            "NI_Scaling_Status": "unscaled",
            "NI_Scale[0]_Scale_Type": "Linear",
            "NI_Scale[0]_Linear_Slope": slope,
            "NI_Scale[0]_Linear_Y_Intercept": 0.0,
            "NI_Scale[0]_Linear_Input_Source": np.uint32(0xFFFFFFFF),
        }
        kept.append((np.round(values / slope).astype(np.int16), scale, unit))
    cuts = [0, 901, 7000, 7001, len(force)]
    with TdmsWriter(path) as writer:
        for start, stop in itertools.pairwise(cuts):
            writer.write_segment(
                [
                    ChannelObject(
                        *("DAQ", name, raw[start:stop]),
                        {"wf_increment": 1 / RATE, "unit_string": unit, **scale},
                    )
                    for name, (raw, scale, unit) in zip(("ai0", "ai1"), kept, strict=True)
                ]
            )
    return "ai0", "ai1:acceleration", ""


def imported(path, written, *words):
    force, response, unit = written
    options = ["--force", force, "--response", response, "--sensor", "tip", *words]
    out = path.parent / "out"
    code, output = run(path, *options, *(["--force-unit", unit] if unit else []), "--out", out)
    assert code == 0, output
    return read_steady_states(out / "measured.csv"), output


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (as_tdms, "sweep.tdms"),
        pytest.param(as_matlab, "sweep.mat", marks=pytest.mark.long),  # as the other, three seconds
    ],
)
def test_slow_sweeps_become_steady_states(tmp_path, write, name):
    """The sweep alone shifts the peak by half its half-width: the import corrects that."""
    path = tmp_path / name
    states, output = imported(path, write(path, *sweeps()))
    assert read_import_map(tmp_path / "out" / "map.toml").record == "sweep"
    assert "2 sweeps shifts the peak by up to 0.08" in " ".join(output.split())
    omega = np.asarray(states.frequency)
    near = np.abs(omega / REST - 1) < 2 * RATIO
    measured_mobility = (np.asarray(states.velocity)[:, 0] / np.asarray(states.force))[near]
    assert set(np.asarray(states.level)[near]) == {1, 2}
    # Windows of 16 cycles leave 3.3e-4 at this rate, where it rings after the resonance.
    np.testing.assert_allclose(measured_mobility, mobility(omega[near]), rtol=5e-4)
    # Without correction the phasors would be in error by more than a tenth.
    passed = np.asarray(states.force)[near] / np.where(np.asarray(states.level)[near] == 1, 20, 40)
    assert np.abs(passed - 1).max() > 0.1


def steps(hertz, force, dwell=6.0):
    """Force and acceleration of steps of `dwell` seconds, settled from the beginning."""
    parts = []
    for f in hertz:
        phase = HERTZ * f * np.arange(round(dwell * RATE)) / RATE
        response = force * 1j * HERTZ * f * mobility(HERTZ * f)
        parts.append([force * np.cos(phase), (response * np.exp(1j * phase)).real])
    return np.concatenate(parts, axis=1)


def test_the_map_of_one_file_gives_each_of_several_files_its_own_level(tmp_path):
    hertz = np.array([9.5, 10.0, 10.5])
    paths = [tmp_path / f"{name}.mat" for name in ("low", "high")]
    options = [
        as_matlab(path, *steps(hertz, f)) for path, f in zip(paths, (10.0, 25.0), strict=True)
    ]
    imported(paths[0], options[0])
    out = tmp_path / "both"
    code, output = run(*paths, "--map", tmp_path / "out" / "map.toml", "--out", out)
    assert code == 0, output
    assert read_import_map(out / "map.toml").level == "auto"
    states = read_steady_states(out / "measured.csv")
    np.testing.assert_array_equal(states.level, [1, 1, 1, 2, 2, 2])
    np.testing.assert_allclose(states.force, np.repeat([10.0, 25.0], 3), rtol=1e-5)


def test_steps_of_a_tdms_file(tmp_path):
    """Ten steps at two forces, settled from the beginning: any error is that of the import."""
    path = tmp_path / "steps.tdms"
    hertz = np.array([9.5, 9.8, 10.0, 10.2, 10.5])
    parts = np.concatenate([steps(hertz, force) for force in (10.0, 25.0)], axis=1)
    states, _ = imported(path, as_tdms(path, *parts))
    assert read_import_map(tmp_path / "out" / "map.toml").record == "steps"
    np.testing.assert_array_equal(states.level, np.repeat([1, 2], 5))
    np.testing.assert_allclose(states.frequency, np.tile(hertz, 2) * HERTZ, rtol=1e-6)
    np.testing.assert_allclose(states.force, np.repeat([10.0, 25.0], 5), rtol=1e-5)
    wanted = np.asarray(states.force) * mobility(np.asarray(states.frequency))
    # Half a step of 16 bits: 10 Hz at 200 Hz repeats its roundings, which do not average out.
    half = np.abs(wanted).max() / 32767 / 2
    np.testing.assert_allclose(np.asarray(states.velocity)[:, 0], wanted, rtol=0, atol=2 * half)
