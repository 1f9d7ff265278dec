"""Records of files larger than memory: `snrmjax import` of a stepped sine from HDF5 and TDMS.

Run: python benchmarks/long_files.py [--gigabytes 4] [--folder FOLDER] [--format hdf5] ...

The record of `long_records.py` (two channels of int16 at 10 kHz, 500 steps, noise) is written
block by block by h5py, or by nptdms' writer as LabVIEW does, a segment every 2^20 samples; a
process of its own imports it as the command does, from reading the file to `measured.csv`. The
file is removed.

One JSON line a format: GB of the file, seconds, peak resident memory in MB, what of it was there
before, states, and the largest relative error of a step's mobility.
"""

import argparse
import json
import multiprocessing
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from long_records import FULL, HERTZ, HIGH, LOW, RATE, STEPS, Computed, gain, resident

BLOCK = 2**20


def write(kind, path, samples):
    """The record as a file."""
    source = Computed("stepped", samples)
    starts = range(0, samples, BLOCK)
    blocks = (source.read((0, 1), k, min(k + BLOCK, samples)) for k in starts)
    if kind == "hdf5":
        import h5py

        with h5py.File(path, "w") as file:
            file.attrs["fs"] = RATE
            sets = [
                file.create_dataset(name, (samples,), np.int16, chunks=(2**16,))
                for name in ("force", "motion")
            ]
            for start, block in zip(starts, blocks, strict=True):
                for one, row in zip(sets, block, strict=True):
                    one[start : start + len(row)] = row
    else:
        from nptdms import ChannelObject, TdmsWriter

        with TdmsWriter(path) as writer:
            for block in blocks:
                wave = {"wf_increment": 1 / RATE, "wf_start_offset": 0.0}
                rows = zip(("force", "motion"), block, strict=True)
                writer.write_segment([ChannelObject("log", name, row, wave) for name, row in rows])


def digest(kind, path):
    """Import the file and print the line."""
    from snrmjax.io.exchange.exports import write_import
    from snrmjax.io.exchange.import_map import ImportMap, response_word
    from snrmjax.io.exchange.importing import import_files

    told = ImportMap(
        (response_word("motion:displacement", f"{1 / FULL!r} m"),),
        force="force",
        force_unit=f"{1 / FULL!r} N",
    )
    before, begin = resident(), time.perf_counter()
    found = import_files([path], told)
    write_import(path.parent, found)
    states = found.states
    hertz = np.asarray(states.frequency) / HERTZ
    wanted = np.linspace(LOW, HIGH, STEPS)
    near = wanted[np.abs(hertz[:, None] - wanted).argmin(axis=1)]
    ratio = np.asarray(states.velocity)[:, 0] / np.asarray(states.force)
    error = ratio / (1j * HERTZ * near * gain(HERTZ * near)) - 1
    line = {
        "benchmark": "long_files",
        "format": kind,
        "gigabytes": round(path.stat().st_size / 1e9, 2),
        "seconds": round(time.perf_counter() - begin, 1),
        "peak_mb": round(resident()),
        "before_mb": round(before),
        "states": states.n_states,
        "error": float(np.abs(error).max()),
    }
    print(json.dumps(line), flush=True)


def main():
    """Every format that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=4.0)
    parser.add_argument("--format", choices=("hdf5", "tdms"), action="append")
    parser.add_argument("--folder", default=None)
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    for kind in options.format or ("hdf5", "tdms"):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            if shutil.disk_usage(folder).free < 2e9 * options.gigabytes:
                raise SystemExit(f"{folder} has too little room for {options.gigabytes} GB.")
            path = Path(folder) / f"record.{'h5' if kind == 'hdf5' else 'tdms'}"
            for work in (write, digest):
                rest = (int(options.gigabytes * 1e9 / 4),) if work is write else ()
                child = context.Process(target=work, args=(kind, path, *rest))
                child.start()
                child.join()
                if child.exitcode:
                    raise SystemExit(f"{work.__name__} of {kind} ended with {child.exitcode}.")


if __name__ == "__main__":
    main()
