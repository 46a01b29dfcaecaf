"""Build a store with jobs of a Slurm cluster, started by dask-jobqueue."""

import os
from pathlib import Path

from dask_jobqueue import SLURMCluster

from slatprep import build_store, load_parameters
from slatprep.workers.dask import Cluster

if __name__ == "__main__":
    os.environ["DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED"] = "False"
    with SLURMCluster(
        queue="cpu",
        account="my-account",
        walltime="04:00:00",
        cores=16,
        processes=16,
        memory="32GiB",
        worker_extra_args=["--lifetime", "225m", "--lifetime-stagger", "10m"],
        job_script_prologue=[
            "export MALLOC_TRIM_THRESHOLD_=67108864 MALLOC_MMAP_THRESHOLD_=33554432",
            "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False",
        ],
    ) as slurm:
        slurm.scale(jobs=8)
        with Cluster(slurm.scheduler_address, note=print) as cluster:
            build_store(load_parameters(Path("demo.toml")), Path("/data/demo.zarr"), jobs=cluster)
