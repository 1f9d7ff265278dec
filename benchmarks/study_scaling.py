"""Time, memory and disk of large studies on one and two processes and on a Dask cluster.

    python benchmarks/study_scaling.py --one-mode 100000 --flat 10000

Peaks of a one-mode structure with a cubic stiffness (three harmonics) and of the flat beam (nine),
damping and cubic coefficient drawn from a Sobol' sequence, with folds but without stability.
Prints one JSON line a study, with the memory of the largest process so far, and one that compares
the digits of the data sets. Run it on an idle machine.
"""

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import snrmjax as sj
from snrmjax.study.run import Progress

HERTZ = 2 * np.pi
FORCES = {"one_mode": 0.0133, "flat_beam": 0.0133}
HARMONICS = {"one_mode": 3, "flat_beam": 9}


def one_mode() -> sj.model.Structure:
    """The flat beam's first mode alone."""
    modes = sj.model.linear_modes([79.02 * HERTZ], [0.05], [[11.84338]], [247.841])
    return sj.model.structure(modes, sj.model.polynomial_potential({(0, 0, 0, 0): 3.4375e12}, 1))


def study_of(name: str, members: int, chunk: int) -> sj.study.Study:
    """A study of `members` members."""
    model = one_mode() if name == "one_mode" else sj.model.flat_beam()
    within = sj.study.ResponseRange(
        60 * HERTZ, 120 * HERTZ, harmonic_order=HARMONICS[name], stability=False
    )
    varied = (
        sj.study.LogNormal("mode_1.damping_ratio", 0.05, 0.005),
        sj.study.Normal("potential.1111", 3.4375e12, 1e11),
    )
    return sj.study.Study(
        name,
        model,
        sj.study.Peaks(within, [FORCES[name]]),
        varied,
        sj.study.Sampling("sobol", members),
        seed=1,
        members_a_chunk=chunk,
    )


def folder_size(path: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def contents(path: Path) -> dict[str, bytes]:
    """Every file of a data set."""
    return {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


def timed(study: sj.study.Study, out: Path, **settings: object) -> dict:
    """One run."""
    steps: list[Progress] = []
    begin = time.perf_counter()
    run = sj.study.run_study(study, out, progress=steps.append, **settings)
    seconds = time.perf_counter() - begin
    first = steps[0].done
    return {
        "members": run.members,
        "failed": run.failed,
        "seconds": round(seconds, 1),
        # Without the first chunk, which compiles.
        "ms_a_curve": round(
            1e3 * (steps[-1].seconds - steps[0].seconds) / max(run.members - first, 1), 3
        ),
        "largest_process_mb": round(
            resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3, 1
        ),
        "data_set_mb": round(folder_size(out) / 1e6, 3),
        "parts_mb": round(folder_size(out.with_name(f"{out.name}.parts")) / 1e6, 3),
    }


def main() -> None:
    """See the module."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--one-mode", type=int, default=2000)
    options.add_argument("--flat", type=int, default=400)
    options.add_argument("--chunk", type=int, default=128)
    options.add_argument("--without", nargs="*", default=[], help="of 1, 2, dask")
    chosen = options.parse_args()
    for name, members in (("one_mode", chosen.one_mode), ("flat_beam", chosen.flat)):
        study, stores = study_of(name, members, chosen.chunk), {}
        with tempfile.TemporaryDirectory() as folder:
            for how in ("1", "2", "dask"):
                if how in chosen.without or not members:
                    continue
                out = Path(folder) / f"{how}.zarr"
                if how == "dask":
                    from distributed import LocalCluster

                    with LocalCluster(
                        n_workers=2, threads_per_worker=1, dashboard_address=None
                    ) as cluster:
                        line = timed(study, out, scheduler=cluster.scheduler_address)
                else:
                    line = timed(study, out, processes=int(how))
                stores[how] = contents(out)
                report = {"benchmark": "study_scaling", "model": name, "processes": how, **line}
                print(json.dumps(report), flush=True)
            if stores:
                first = next(iter(stores.values()))
                equal = all(one == first for one in stores.values())
                print(json.dumps({"benchmark": "study_scaling", "model": name, "equal": equal}))


if __name__ == "__main__":
    main()
