"""Run jobs in processes of this machine, on a Ray cluster, or as a SLURM job array.

To add a launcher, write a :data:`Runner`, a class in ``hydra_plugins.dopepp_plugins.launchers`` and
a file in ``conf/hydra/launcher``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from dopepp.core.errors import UserError, require
from dopepp.core.pool import (
    THREAD_LIMITS,
    ClusterPool,
    LostWorkerError,
    Pool,
    ProcessPool,
    available_cores,
)
from dopepp.core.validation import Range, check
from dopepp.experiment.results import display
from dopepp.experiment.results.folder import FAILURE_FILE, write_json

_MOST: Final = 1024

_ANYWHERE: Final = (
    "timeout_min",
    "nodes",
    "tasks_per_node",
    "cpus_per_task",
    "gpus_per_node",
    "mem_gb",
    "name",
)
"""Options that every submitit cluster accepts; other options get the prefix ``slurm_``."""


@dataclass(frozen=True)
class Jobs:
    """Function that runs a job of a multirun, with the data that all jobs share."""

    context: HydraContext
    config: DictConfig
    task: TaskFunction
    state: dict[Any, Any] = field(default_factory=Singleton.get_state)  # of the launching process

    @property
    def folder(self) -> Path:
        """Folder of the multirun; a job runs in the subfolder named after its number."""
        return Path(str(self.config.hydra.sweep.dir))

    def __call__(self, job: tuple[int, list[str]]) -> JobReturn:
        """Run a job, given by number and overrides, in this process."""
        number, overrides = job
        setup_globals()
        Singleton.set_state(self.state)
        config = self.context.config_loader.load_sweep_config(self.config, overrides)
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        result = run_job(
            task_function=self.task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
            hydra_context=self.context,
        )
        # Configs contain classes that Hydra imports twice, so they cannot be pickled.
        result.cfg = result.hydra_cfg = None
        return result

    def checkpoint(self, job: tuple[int, list[str]]) -> Any:
        """Return the job for resubmission; submitit calls this near SLURM's time limit."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, job)


Ended = Iterator[tuple[int, JobReturn | Exception]]
"""Results of jobs by number, in the order of completion; an exception for a lost process."""

Runner = Callable[[Jobs, Mapping[int, list[str]]], Ended]
"""Function that runs jobs, given as overrides by number."""


def launch(
    jobs: Jobs, overrides: Sequence[Sequence[str]], first: int, run: Runner
) -> list[JobReturn]:
    """Run jobs numbered from ``first`` and wait; write ``failed.json`` if a process dies."""
    jobs.folder.mkdir(parents=True, exist_ok=True)
    numbered = {number: list(texts) for number, texts in enumerate(overrides, first)}
    returns: dict[int, JobReturn] = {}
    for number, result in run(jobs, numbered):
        if isinstance(result, Exception):
            folder = jobs.folder / str(number)
            folder.mkdir(parents=True, exist_ok=True)
            reason = f"{type(result).__name__}: {' '.join(str(result).split())}"
            write_json(
                folder / FAILURE_FILE, {"reason": f"the process of the job was lost: {reason}"}
            )
            # An error status would make Hydra end the multirun.
            result = JobReturn(status=JobStatus.COMPLETED)
        returns[number] = result
        display.console.print(f"job {number} ended, {len(returns)} of {len(numbered)}")
    return [returns[number] for number in numbered]


def on_joblib(n_jobs: int) -> Runner:
    """Return a runner with ``n_jobs`` parallel processes on this machine."""
    check("hydra.launcher.n_jobs", n_jobs, int, Range(1, _MOST))
    require("joblib", "hydra/launcher=joblib", "joblib")

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        # Unlike pickle, cloudpickle serialises objects that scripts define.
        from joblib.externals.loky.cloudpickle_wrapper import dumps

        share = str(max(available_cores() // n_jobs, 1))
        limits = {name: os.environ.get(name, share) for name in THREAD_LIMITS}
        return _run(ProcessPool(dumps(jobs), n_jobs, limits), overrides)

    return run


def on_ray(address: str | None, num_cpus: float, num_gpus: float) -> Runner:
    """Return a runner on a Ray cluster at ``host:port``; None starts a cluster on this machine.

    A job takes ``num_cpus`` cores and ``num_gpus`` GPUs, which may be a fraction.
    """

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        require("ray", "hydra/launcher=ray", "ray")
        from ray import cloudpickle

        pool = ClusterPool(
            cloudpickle.dumps(jobs),
            address,
            available_cores(),
            "hydra/launcher=ray",
            "hydra.launcher.address",
            # A job that crashed its process would probably crash a second process.
            max_retries=0,
            num_cpus=num_cpus,
            num_gpus=num_gpus,
        )
        return _run(pool, overrides)

    return run


def _run(pool: Pool, overrides: Mapping[int, list[str]]) -> Ended:
    """Yield number and result of each finished job; an exception if its process died."""
    with pool:
        for (number, _), future in pool.run(overrides.items()):
            try:
                yield number, future.result()
            except LostWorkerError as error:
                yield number, error


def on_slurm(folder: str, cluster: str, max_num_timeout: int, sbatch: Mapping[str, Any]) -> Runner:
    """Return a runner that submits a job array and waits for it.

    SLURM's logs are written to ``folder``. The cluster is ``slurm``, or ``local`` for processes of
    this machine. ``sbatch`` has options by submitit's names; None selects the cluster's default.
    """
    require("submitit", "hydra/launcher=submitit_slurm", "slurm")
    given = {key: value for key, value in sbatch.items() if value is not None}
    named = {key if key in _ANYWHERE else f"slurm_{key}": value for key, value in given.items()}

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        import submitit
        from submitit.core.utils import FailedJobError, UncompletedJobError

        try:
            slurm = {"cluster": cluster, "slurm_max_num_timeout": max_num_timeout}
            executor = submitit.AutoExecutor(folder, **slurm)
            executor.update_parameters(**named)
            handles = executor.map_array(jobs, overrides.items())
        except (RuntimeError, ValueError, NameError, TypeError, OSError) as error:
            raise UserError(
                f"hydra/launcher=submitit_slurm, which failed: {error}",
                "a machine with srun and sbatch, and sbatch options that the cluster accepts",
                "change the option hydra.launcher.… that this message names, or run the jobs on "
                "this machine with hydra.launcher.cluster=local",
            ) from error
        numbers = dict(zip((handle.job_id for handle in handles), overrides, strict=True))
        for handle in submitit.helpers.as_completed(handles):
            try:
                yield numbers[handle.job_id], handle.result()
            except (UncompletedJobError, FailedJobError) as error:
                yield numbers[handle.job_id], error

    return run
