"""Runs of whole studies in this process: what is computed, kept, refused and repaired."""

import os
import shutil
import subprocess
import sys
import threading
import zipfile

import numpy as np
import pytest
from filelock import FileLock
from loky.backend import get_context
from scipy.optimize import minimize_scalar

import snrmjax as sj
from snrmjax.study.execution import LOST, WorkerDied, available_cores, local_processes, settle

from .conftest import OMEGA, InThisProcess, peak_velocity

DAMPING = np.linspace(0.01, 0.03, 7)


def run_here(study, out, executor=None, **settings):
    workers = (executor or InThisProcess()).workers
    return sj.study.run_study(study, out, workers=workers, **settings)


def identical(one, other):
    """Whether two folders have the same files with the same bytes."""
    return subprocess.run(["diff", "-r", one, other], check=False).returncode == 0


@pytest.fixture(scope="module")
def finished(tmp_path_factory, request):
    """A study that nothing disturbed."""
    study = request.getfixturevalue("study_of_module")
    out = tmp_path_factory.mktemp("study") / "study.zarr"
    run_here(study, out)
    return out


@pytest.fixture(scope="module")
def study_of_module(linear_model, linear_peaks):
    return sj.study.Study(
        "damping of a linear mode",
        linear_model,
        linear_peaks([0.5]),
        (sj.study.Uniform("mode_1.damping_ratio", 0.01, 0.03, 7),),
        members_a_chunk=3,
    )


def copied(finished, folder, *, with_data_set=True):
    """A copy of a finished study, or of its parts alone."""
    out = folder / finished.name
    shutil.copytree(f"{finished}.parts", f"{out}.parts")
    if with_data_set:
        shutil.copytree(finished, out)
    return out


def chunk_files(out):
    return sorted((out.parent / f"{out.name}.parts" / "chunks").glob("*.npz"))


def test_every_member_has_the_peak_of_its_own_damping(finished):
    data = sj.study.open_study(finished)
    np.testing.assert_allclose(data["mode_1.damping_ratio"], DAMPING, rtol=1e-15)
    assert set(data.status.values.tolist()) == {"upper_end"}
    # Located peaks are polished by Newton's method; velocity is largest at the natural frequency.
    np.testing.assert_allclose(data.peak_velocity_m_s, peak_velocity(0.5, DAMPING), rtol=1e-9)
    np.testing.assert_allclose(data.peak_frequency_hz, 50.0, rtol=1e-6)
    np.testing.assert_allclose(data.resonance_frequency_hz, 50.0, rtol=1e-9)
    assert data.attrs["snrmjax_version"]
    assert data.peak_velocity_m_s.attrs["units"] == "m/s"


def test_several_forces_are_a_dimension(linear_model, linear_peaks, tmp_path):
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.01, 0.02]),)
    study = sj.study.Study("forces", linear_model, linear_peaks([0.5, 1.0, 2.0]), varied)
    data = run_here(study, tmp_path / "s.zarr").open()
    assert dict(data.sizes) == {"member": 2, "force_n": 3, "fold": 0}
    expected = peak_velocity(np.array([0.5, 1.0, 2.0]), np.array([[0.01], [0.02]]))
    np.testing.assert_allclose(data.peak_velocity_m_s, expected, rtol=1e-9)


def test_force_and_frequency_in_hertz_vary_together(linear_model, linear_peaks, tmp_path):
    varied = (
        sj.study.Discrete("force_n", [0.5, 1.0]),
        sj.study.Discrete("mode_1.frequency_hz", [48.0, 52.0]),
    )
    sampling = sj.study.Sampling("list")
    study = sj.study.Study("both", linear_model, linear_peaks(), varied, sampling)
    data = run_here(study, tmp_path / "s.zarr").open()
    np.testing.assert_allclose(data.resonance_frequency_hz, [48.0, 52.0], rtol=1e-9)
    expected = peak_velocity(np.array([0.5, 1.0]), 0.02) * 50 / np.array([48.0, 52.0])
    np.testing.assert_allclose(data.resonance_velocity_m_s, expected, rtol=1e-9)


def test_curves_are_ragged_rows_that_members_point_to(linear_model, study_of_module, tmp_path):
    within = study_of_module.computation.within
    forces = study_of_module.computation.forces
    curves = sj.study.Curves(within, forces)
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.01, 0.03]),)
    study = sj.study.Study("curves", linear_model, curves, varied, members_a_chunk=1)
    data = run_here(study, tmp_path / "s.zarr").open()
    for k, damping in enumerate((0.01, 0.03)):
        begin, n = int(data.first_point[k]), int(data.n_points[k])
        rows = slice(begin, begin + n)
        omega = 2 * np.pi * data.point_frequency_hz.values[rows]
        own = 2 * np.pi * 50.0
        linear = 1j * omega * 0.5 * 6.0 / (own**2 - omega**2 + 2j * damping * own * omega)
        measured = data.point_velocity_re_m_s + 1j * data.point_velocity_im_m_s
        # Points between events are corrected to `StepControl.tolerance`.
        np.testing.assert_allclose(measured.values[rows], linear, rtol=1e-6)
    assert int(data.n_points.sum()) == data.sizes["point"]


def test_what_is_there_is_not_computed_again(study_of_module, finished, tmp_path):
    out, workers = copied(finished, tmp_path), InThisProcess()
    again = run_here(study_of_module, out, workers)
    assert again.complete
    assert (again.computed, workers.done) == (0, [])


@pytest.mark.parametrize("harm", ["flip", "cut", "temporary"])
def test_a_damaged_chunk_is_found_and_computed_again(study_of_module, finished, tmp_path, harm):
    out = copied(finished, tmp_path, with_data_set=False)
    file = chunk_files(out)[1]
    content = file.read_bytes()
    if harm == "flip":
        at = zipfile.ZipFile(file).infolist()[-1].header_offset - 10  # within the rows before it
        file.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    elif harm == "cut":
        file.write_bytes(content[:-10])
    else:
        file.rename(file.with_name(".abc.tmp"))
    workers = InThisProcess()
    again = run_here(study_of_module, out, workers)
    assert (again.computed, workers.done) == (3, ["compute_chunk"])
    assert identical(finished, out)
    assert len(list(chunk_files(out)[0].parent.iterdir())) == 3


def test_a_damaged_data_set_is_made_again_from_its_chunks(study_of_module, finished, tmp_path):
    out, workers = copied(finished, tmp_path), InThisProcess()
    file = out / "peak_velocity_m_s" / "0"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    run_here(study_of_module, out, workers)
    assert workers.done == []
    assert identical(finished, out)


def test_shards_make_the_same_data_set(study_of_module, finished, tmp_path):
    out = tmp_path / finished.name
    first = run_here(study_of_module, out, shard=(2, 2))
    assert not first.complete
    assert first.missing_chunks == 2
    with pytest.raises(ValueError, match="is not complete"):
        first.open()
    assert run_here(study_of_module, out, shard=(1, 2)).complete
    assert identical(finished, out)


def test_a_chunk_whose_process_dies_by_chance_is_computed(study_of_module, finished, tmp_path):
    deaths = iter([True, False, True, True, False, False])

    def before(function, *arguments):
        if next(deaths, False):
            raise WorkerDied("killed")

    out = tmp_path / finished.name
    run_here(study_of_module, out, InThisProcess(before))
    assert identical(finished, out)


def test_a_member_that_kills_its_process_is_a_row_with_a_status(study_of_module, tmp_path):
    def before(function, planned, *rest):
        numbers = rest[0] if function.__name__ == "computed_rows" else planned.rows_of(rest[1])
        if 4 in numbers:
            raise WorkerDied("killed")

    run = run_here(study_of_module, tmp_path / "s.zarr", InThisProcess(before))
    data = run.open()
    assert run.failed == 1
    assert data.status.values[4] == str(LOST) == "lost: the process that computed it died"
    assert np.isnan(data.peak_velocity_m_s[4])
    others = np.arange(7) != 4
    expected = peak_velocity(0.5, DAMPING[others])
    np.testing.assert_allclose(data.peak_velocity_m_s[others], expected, rtol=1e-9)


def test_another_study_is_refused_with_what_differs(linear_model, linear_peaks, finished, tmp_path):
    out = copied(finished, tmp_path)
    varied = (sj.study.Uniform("mode_1.damping_ratio", 0.01, 0.03, 7),)
    other = sj.study.Study(
        "damping of a linear mode", linear_model, linear_peaks([0.6]), varied, members_a_chunk=3
    )
    with pytest.raises(ValueError, match=r"forces\.values\[0\]` is 0.6 here and 0.5 in the store"):
        run_here(other, out)
    assert identical(finished, out)


def test_another_version_is_refused(study_of_module, finished, tmp_path, monkeypatch):
    out = copied(finished, tmp_path)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "99")
    with pytest.raises(ValueError, match=r"versions\.jax` is '99' here"):
        run_here(study_of_module, out)


def test_one_process_at_a_time(study_of_module, finished, tmp_path):
    out = copied(finished, tmp_path, with_data_set=False)
    with (
        FileLock(f"{out}.parts/.lock"),
        pytest.raises(ValueError, match="another process is at work"),
    ):
        run_here(study_of_module, out)


def test_a_disk_that_is_full_costs_nothing_that_is_done(study_of_module, finished, tmp_path):
    def before(function, planned, folder, number):
        if number == 2:
            raise OSError(28, "No space left on device")

    out = tmp_path / finished.name
    with pytest.raises(ValueError, match=r"No space left on device\. Completed chunks are kept"):
        run_here(study_of_module, out, InThisProcess(before))
    workers = InThisProcess()
    run_here(study_of_module, out, workers)
    assert workers.done == ["compute_chunk"]
    assert identical(finished, out)


def test_a_worker_ends_with_the_process_that_started_it():
    # No core is assigned: the queue stays empty.
    code = "import queue; from snrmjax.study.execution import settle; settle(2**30, queue.Queue())"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 1


def test_a_core_goes_from_a_worker_that_ended_to_the_next_one():
    # As where loky exchanges a worker that has grown: with no core left it would wait for ever.
    context = get_context("loky")
    cores = context.SimpleQueue()
    cores.put(available_cores()[0])
    for _ in range(2):
        worker = context.Process(target=settle, args=(os.getpid(), cores))
        worker.start()
        worker.join(60)
        assert worker.exitcode == 0


def test_a_pool_that_is_closed_leaves_no_thread_which_holds_locks():
    before = {*threading.enumerate()}
    workers = local_processes(1)
    assert workers.result(workers.submit(abs, -3)) == 3
    workers.close()
    for thread in {*threading.enumerate()} - before:  # loky's own ends by itself
        thread.join(20)
        assert not thread.is_alive()


def test_a_scheduler_that_is_not_there_leaves_nothing(study_of_module, tmp_path, monkeypatch):
    monkeypatch.setattr("snrmjax.study.execution._PATIENCE", "1s")
    with pytest.raises(ValueError, match="no Dask scheduler answers at 127"):
        sj.study.run_study(study_of_module, tmp_path / "s.zarr", scheduler="127.0.0.1:9")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_study_is_left_alone(study_of_module, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(ValueError, match="no data set of a study"):
        run_here(study_of_module, tmp_path / "mine")
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_without_its_chunks_the_data_set_stands_alone(study_of_module, finished, tmp_path):
    out, workers = copied(finished, tmp_path), InThisProcess()
    shutil.rmtree(f"{out}.parts")
    assert run_here(study_of_module, out, workers).complete
    assert workers.done == []


def test_a_model_may_be_made_of_other_numbers(linear_model, linear_peaks, tmp_path):
    varied = (sj.study.Discrete("loss_factor", [0.02, 0.08]),)
    study = sj.study.Study(
        "loss factor", linear_model, linear_peaks([0.5]), varied, model_of=of_loss_factor
    )
    data = run_here(study, tmp_path / "s.zarr").open()
    expected = peak_velocity(0.5, np.array([0.01, 0.04]))
    np.testing.assert_allclose(data.peak_velocity_m_s, expected, rtol=1e-9)


def of_loss_factor(values):
    """A structure of its loss factor, which is twice the damping ratio."""
    modes = sj.model.linear_modes([2 * np.pi * 50], [values["loss_factor"] / 2], [[2.0]], [3.0])
    return sj.model.structure(modes)


def test_functions_that_name_the_package_reach_other_processes():
    # As those of a notebook do, which are sent by value; lazy-loader 0.6 made modules unpicklable.
    from loky.backend.reduction import dumps

    namespace = {"sj": sj, "__name__": "__main__"}
    exec("def beam(values): return sj.model.flat_beam()", namespace)
    assert len(dumps(namespace["beam"])) < 10_000


@pytest.fixture(scope="module")
def two_sensors():
    """Two linear modes of which sensor a sees one more and sensor b the other."""
    modes = sj.model.linear_modes(
        *([OMEGA, 1.2 * OMEGA], [0.02, 0.02], [[2.0, 0.2], [0.1, 2.0]], [3.0, 3.0]),
        sensors=("a", "b"),
    )
    return sj.model.structure(modes)


def linear_peak(model, sensor, force):
    """Largest velocity of two linear modes by SciPy and the frequency in Hz where it is."""
    modes = model.modes
    own, shape = np.asarray(modes.natural_frequency), np.asarray(modes.shape_at(sensor))

    def speed(omega):
        stiffness = own**2 - omega**2 + 0.04j * own * omega
        return abs(np.sum(1j * omega * force * shape * 3.0 / stiffness))

    grid = np.linspace(0.8, 1.4, 601) * OMEGA
    near = grid[np.argmax([speed(omega) for omega in grid])]
    ends = (near - 0.01 * OMEGA, near + 0.01 * OMEGA)
    found = minimize_scalar(
        lambda omega: -speed(omega), bounds=ends, method="bounded", options={"xatol": 1e-7 * OMEGA}
    )
    return found.x / (2 * np.pi), -found.fun


def test_a_study_has_the_outputs_of_its_sensor(two_sensors, tmp_path):
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.4 * OMEGA, harmonic_order=1, stability=False)
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.02]),)

    def study(sensor):
        peaks = sj.study.Peaks(within, [0.5])
        return sj.study.Study("sensors", two_sensors, peaks, varied, sensor=sensor)

    for sensor in ("a", "b"):
        out = tmp_path / f"{sensor}.zarr"
        data = run_here(study(sensor), out).open()
        hertz, velocity = linear_peak(two_sensors, sensor, 0.5)
        # Located peaks are polished by Newton's method; SciPy's frequency is good to 1e-7.
        np.testing.assert_allclose(data.peak_velocity_m_s, velocity, rtol=1e-9)
        np.testing.assert_allclose(data.peak_frequency_hz, hertz, rtol=1e-6)
        assert data.attrs["sensor"] == sensor
        long_name = data.peak_velocity_m_s.attrs["long_name"]
        assert long_name == f"velocity at the highest peak, at {sensor}"
    # A study that names no sensor, as one begun before, is that of the first.
    again = InThisProcess()
    run_here(study(None), tmp_path / "a.zarr", again)
    assert again.done == []
    with pytest.raises(ValueError, match="`sensor` is 'absent' here and 'b' in the store"):
        run_here(study(None), tmp_path / "b.zarr")
    with pytest.raises(ValueError, match=r"the sensor 'c'; known are a, b\."):
        study("c").ensemble()


def test_virtual_tests_use_the_sensor_that_moves_most(two_sensors):
    within = sj.study.ResponseRange(0.8 * OMEGA, 1.1 * OMEGA)
    tests = sj.study.VirtualTests(within, np.array([0.5]))
    varied = (sj.study.Discrete("mode_1.damping_ratio", [0.02]),)
    assert sj.study.Study("test", two_sensors, tests, varied).reported_sensor == "a"
    with pytest.raises(ValueError, match="virtual_test uses a, where the mode of interest"):
        sj.study.Study("test", two_sensors, tests, varied, sensor="b").ensemble()
