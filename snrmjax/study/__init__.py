"""Sweeps and uncertainty studies: many members of one model, stored as one labelled data set.

A study is a TOML file (the how-to on studies has one), run on this machine by
`snrmjax study run study.toml --out study.zarr` and drawn by
`snrmjax study report study.zarr --out report`.

On a batch queue, every task of an array computes its part on a shared folder, and the last one to
end makes the data set; a task that was killed is submitted again. With SLURM:

    #SBATCH --array=1-20 --cpus-per-task=8 --time=2:00:00
    snrmjax study run study.toml --out study.zarr --shard $SLURM_ARRAY_TASK_ID/20

Or with workers managed by Dask (snrmjax[cluster] and dask-jobqueue):

    from dask_jobqueue import SLURMCluster
    import snrmjax as sj

    cluster = SLURMCluster(cores=8, processes=8, memory="16GB", walltime="02:00:00")
    cluster.scale(jobs=20)
    study = sj.study.read_study("study.toml")
    # Called again, it continues:
    sj.study.run_study(study, "study.zarr", scheduler=cluster.scheduler_address)

Each worker needs the same versions and access to the same folders; it computes with one thread.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
