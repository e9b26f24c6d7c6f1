"""Jobs in other processes: of this machine, of a Ray cluster, or of SLURM as one job array.

To add a launcher, write a :data:`Runner`, a class in ``hydra_plugins.dopepp_plugins.launchers`` and
a file in ``conf/hydra/launcher``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
"""What submitit calls by these names on every kind of cluster; the rest is SLURM's own."""


@dataclass(frozen=True)
class Jobs:
    """What the jobs of a multirun have in common; travels to the processes that run them."""

    context: HydraContext
    config: DictConfig
    task: TaskFunction
    state: dict[Any, Any]

    @classmethod
    def of(cls, context: HydraContext, config: DictConfig, task: TaskFunction) -> Jobs:
        """Gather it in the process that launches."""
        return cls(context, config, task, Singleton.get_state())

    @property
    def folder(self) -> Path:
        """The folder of the multirun; a job's is its number in it."""
        return Path(str(self.config.hydra.sweep.dir))

    def __call__(self, job: tuple[int, list[str]]) -> JobReturn:
        """Run one job, a number and its overrides, in this process."""
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
        # Configs hold classes that Hydra imports twice, so that they cannot be sent back.
        result.cfg = result.hydra_cfg = None
        return result

    def checkpoint(self, job: tuple[int, list[str]]) -> Any:
        """Near SLURM's time limit: submit the same job once more, which goes on in its folder."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, job)


Ended = Iterator[tuple[int, JobReturn | Exception]]
"""Jobs by number as they end: an exception in place of one whose process was lost."""

Runner = Callable[[Jobs, Mapping[int, list[str]]], Ended]
"""Runs jobs, given as overrides by number."""


def launch(
    jobs: Jobs, overrides: Sequence[Sequence[str]], first: int, run: Runner
) -> list[JobReturn]:
    """Run jobs, numbered from ``first``, and wait for all; a lost one has failed, others go on."""
    jobs.folder.mkdir(parents=True, exist_ok=True)
    numbered = {first + index: list(override_list) for index, override_list in enumerate(overrides)}
    returns: dict[int, JobReturn] = {}
    for number, result in run(jobs, numbered):
        if isinstance(result, Exception):
            result = _lost(jobs.folder / str(number), result)
        returns[number] = result
        display.console.print(f"job {number} ended, {len(returns)} of {len(numbered)}")
    return [returns[number] for number in numbered]


def _lost(folder: Path, error: Exception) -> JobReturn:
    """Write down, in place of the job itself, that it failed."""
    folder.mkdir(parents=True, exist_ok=True)
    reason = f"its process was lost: {type(error).__name__}: {' '.join(str(error).split())}"
    write_json(folder / FAILURE_FILE, {"reason": reason})
    # To Hydra, it ended like any failed job: an error here would end the multirun.
    return JobReturn(status=JobStatus.COMPLETED)


def on_joblib(n_jobs: int) -> Runner:
    """Return a runner that keeps so many jobs going in processes of this machine."""
    check("hydra.launcher.n_jobs", n_jobs, int, Range(1, _MOST))
    require("joblib", "hydra/launcher=joblib", "joblib")

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        from joblib.externals.loky.cloudpickle_wrapper import dumps  # also of scripts' objects

        share = str(max(available_cores() // n_jobs, 1))
        limits = {name: os.environ.get(name, share) for name in THREAD_LIMITS}
        return _run(ProcessPool(dumps(jobs), n_jobs, limits), overrides)

    return run


def on_ray(address: str | None, num_cpus: float, num_gpus: float) -> Runner:
    """Return a runner of jobs that occupy so many cores and accelerators of a cluster.

    ``address`` is the cluster's ``host:port``; None starts one on this machine for these jobs.
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
            # Not repeated: a job that took its process down once would do so again.
            max_retries=0,
            num_cpus=num_cpus,
            num_gpus=num_gpus,
        )
        return _run(pool, overrides)

    return run


def _run(pool: Pool, overrides: Mapping[int, list[str]]) -> Ended:
    """Yield the results of jobs, or the loss of their process."""
    with pool:
        for (number, _), future in pool.run(overrides.items()):
            try:
                yield number, future.result()
            except LostWorkerError as error:
                yield number, error


def on_slurm(folder: str, cluster: str, max_num_timeout: int, sbatch: Mapping[str, Any]) -> Runner:
    """Return a runner that submits an array and waits for it.

    Args:
        folder: Of SLURM's own logs.
        cluster: ``slurm``, or submitit's ``local``: processes of this machine.
        max_num_timeout: How often a job that reaches its time limit is queued again.
        sbatch: Options by submitit's names; None leaves one to the cluster.
    """
    require("submitit", "hydra/launcher=submitit_slurm", "slurm")
    given = {key: value for key, value in sbatch.items() if value is not None}
    named = {key if key in _ANYWHERE else f"slurm_{key}": value for key, value in given.items()}

    def run(jobs: Jobs, overrides: Mapping[int, list[str]]) -> Ended:
        import submitit

        try:
            slurm = {"cluster": cluster, "slurm_max_num_timeout": max_num_timeout}
            executor = submitit.AutoExecutor(folder, **slurm)
            executor.update_parameters(**named)
            handles = executor.map_array(jobs, overrides.items())
        except (RuntimeError, ValueError, NameError, TypeError, OSError) as error:
            raise UserError(
                f"hydra/launcher=submitit_slurm, which this machine or SLURM refuses: {error}",
                "a machine with srun and sbatch, and options of sbatch that the cluster takes",
                "correct hydra.launcher.…, or try it here with hydra.launcher.cluster=local",
            ) from error
        numbers = dict(zip((handle.job_id for handle in handles), overrides, strict=True))
        for handle in submitit.helpers.as_completed(handles):
            try:
                yield numbers[handle.job_id], handle.result()
            except (
                submitit.core.utils.UncompletedJobError,
                submitit.core.utils.FailedJobError,
            ) as error:
                yield numbers[handle.job_id], error

    return run
