"""Kill a study at random instants, continue it, and compare its data set with an undisturbed one.

    python benchmarks/study_kills.py --kills 50 --seed 1

Half of the studies run on processes of this machine, where the run itself or one of its workers is
killed (SIGKILL); the others on a Dask cluster of two workers, where the run, a worker or the
scheduler is. Every disturbed study is continued by the same command until it ends. Prints one JSON
line a study and one at the end: how many data sets equal the undisturbed one, file by file and
byte by byte.
"""

import contextlib
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from harness import options, teller

import snrmjax as sj

tell = teller(__file__)

STUDY = """name = "killed"
model = "model.toml"
compute = "peaks"
forces_n = [0.0133]
from_hz = 60
to_hz = 120
harmonics = {harmonics}
seed = 3
members_a_chunk = 8
[[vary]]
parameter = "mode_1.damping_ratio"
distribution = "lognormal"
mean = 0.05
std = 0.005
[[vary]]
parameter = "potential.1111"
distribution = "normal"
mean = 3.4375e12
std = 1e11
[sample]
method = "sobol"
members = {members}
"""
PATIENCE = 600


def started(*arguments: str) -> subprocess.Popen:
    """A process of this Python, silent."""
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def workers_of(process: subprocess.Popen) -> list[int]:
    """Process numbers of the workers that a run has started."""
    listed = subprocess.run(
        ["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True
    )
    rows = [line.split(None, 2) for line in listed.stdout.splitlines()[1:]]
    return [
        int(p) for p, parent, what in rows if int(parent) == process.pid and "popen_loky" in what
    ]


class Cluster:
    """A Dask scheduler and two workers on this machine."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        port = self.address.rsplit(":", 1)[1]
        host = ("--host", "127.0.0.1")
        self.scheduler = started(
            "distributed.cli.dask_scheduler", "--port", port, *host, "--no-dashboard"
        )
        work = ("--nthreads", "1", *host, "--no-dashboard")
        self.workers = [
            started("distributed.cli.dask_worker", self.address, *work) for _ in range(2)
        ]

    def close(self) -> None:
        """Stop all of them."""
        for process in (*self.workers, self.scheduler):
            process.terminate()
        for process in (*self.workers, self.scheduler):
            # Without its scheduler a worker may wait for it for ever.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=5)
            process.kill()
            process.wait()


def same(one: Path, other: Path) -> bool:
    """Whether two data sets have the same files with the same bytes."""
    return (
        subprocess.run(["diff", "-r", one, other], capture_output=True, check=False).returncode == 0
    )


def disturbed(study: Path, out: Path, chance: random.Random, longest: float, on: str) -> dict:
    """One study: killed once at a random instant, then continued."""
    cluster = Cluster() if on == "cluster" else None
    command = ["snrmjax", "study", "run", str(study), "--out", str(out), "--quiet"]
    scheduler = ["--scheduler", cluster.address] if cluster else []
    victim = chance.choice(["run", "worker", "scheduler"] if cluster else ["run", "worker"])
    wait = chance.uniform(0.5, longest)
    run = started(*command, *scheduler)
    time.sleep(wait)
    ended_before = run.poll() is not None
    if not ended_before:
        if victim == "run":
            os.kill(run.pid, signal.SIGKILL)
        elif victim == "scheduler":
            os.kill(cluster.scheduler.pid, signal.SIGKILL)
        elif cluster is not None:
            # The nanny's child is what computes; it is started again.
            nanny = chance.choice(cluster.workers).pid
            subprocess.run(["pkill", "-KILL", "-P", str(nanny)], check=False)
        else:
            for pid in workers_of(run)[:1]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
    code = run.wait(timeout=PATIENCE)
    if cluster is not None and victim == "scheduler":
        cluster.close()
        cluster = Cluster()
        scheduler = ["--scheduler", cluster.address]
    again = started(*command, *scheduler).wait(timeout=PATIENCE)
    if cluster is not None:
        cluster.close()
    return {
        "on": on, "victim": "none: it had ended" if ended_before else victim,
        "after_s": round(wait, 2), "exit": code, "exit_continued": again,
    }  # fmt: skip


def main() -> None:
    """See the module."""
    chosen = options(__doc__, kills=50, seed=1, members=96, harmonics=5)
    chance = random.Random(chosen.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sj.io.write_model(folder / "model.toml", sj.model.flat_beam())
        study = folder / "study.toml"
        study.write_text(STUDY.format(members=chosen.members, harmonics=chosen.harmonics))
        undisturbed = folder / "undisturbed.zarr"
        command = ("snrmjax", "study", "run", str(study), "--quiet")
        started(*command, "--out", str(folder / "warm.zarr")).wait()  # fills the program cache
        begin = time.perf_counter()
        started(*command, "--out", str(undisturbed)).wait()
        longest = time.perf_counter() - begin
        equal = killed = 0
        for k in range(chosen.kills):
            out = folder / f"{k}.zarr"
            found = disturbed(study, out, chance, longest, "cluster" if k % 2 else "processes")
            found["equal"] = same(undisturbed, out)
            equal += found["equal"]
            killed += "none" not in found["victim"]
            print(k, found, flush=True)
            shutil.rmtree(out, ignore_errors=True)
            shutil.rmtree(f"{out}.parts", ignore_errors=True)
        tell(studies=chosen.kills, killed=killed, equal=equal, undisturbed_s=longest)


if __name__ == "__main__":
    main()
