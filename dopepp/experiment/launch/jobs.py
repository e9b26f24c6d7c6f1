"""What all launchers share: a job in another process, and what is left of one that was lost.

To add a launcher, write a :data:`Runner`, a class in ``hydra_plugins.dopepp_plugins.launchers`` and
a file in ``conf/hydra/launcher``.

Jobs in several processes of this machine.

Jobs as tasks of a Ray cluster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import cpu_count
from pathlib import Path
from typing import Any, Final

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from dopepp.core.errors import require
from dopepp.data.jobs.cluster import connect
from dopepp.experiment.runs import display, record
from dopepp.models.registry import check_integer


@dataclass(frozen=True)
class Jobs:
    """What the jobs of a multirun have in common; travels to the processes that run them.

    Attributes:
        context: Hydra's config loader and callbacks.
        config: Of the multirun.
        task: The entry point's function.
        state: Hydra's global state.
    """

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

    def run(self, number: int, overrides: list[str]) -> JobReturn:
        """Run one job in this process."""
        setup_globals()
        Singleton.set_state(self.state)
        config = self.context.config_loader.load_sweep_config(self.config, overrides)
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        return run_job(
            task_function=self.task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
            hydra_context=self.context,
        )


Runner = Callable[[Jobs, Mapping[int, list[str]]], Iterator[tuple[int, JobReturn | Exception]]]
"""Runs jobs, given as overrides by number, and yields each as it ends: an exception in place of one
whose process was lost."""


def launch(
    jobs: Jobs, overrides: Sequence[Sequence[str]], first: int, run: Runner
) -> list[JobReturn]:
    """Run jobs and wait for all of them; a lost one has failed, the others go on.

    Args:
        jobs: What they have in common.
        overrides: Of each job.
        first: Number of the first job.
        run: Where they run.

    Raises:
        UserError: They cannot be run there.
    """
    jobs.folder.mkdir(parents=True, exist_ok=True)
    numbered = {first + index: list(one) for index, one in enumerate(overrides)}
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
    record.write_json(folder / record.FAILURE_FILE, {"reason": reason})
    # To Hydra, it ended like any failed job: an error here would end the multirun.
    return JobReturn(status=JobStatus.COMPLETED)


_MOST: Final = 1024


def on_joblib(n_jobs: int) -> Runner:
    """Return a runner that keeps so many jobs going.

    Raises:
        UserError: The number is out of range, or joblib is not installed.
    """
    check_integer("hydra.launcher.n_jobs", n_jobs, 1, _MOST)
    require("joblib", "hydra/launcher=joblib", "joblib")

    def run(
        jobs: Jobs, overrides: Mapping[int, list[str]]
    ) -> Iterator[tuple[int, JobReturn | Exception]]:
        from joblib import Parallel, delayed
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        missing = dict(overrides)
        while missing:
            # One job at a time leaves the queue, so that a lost process takes few with it.
            pool = Parallel(
                n_jobs=n_jobs, backend="loky", return_as="generator_unordered",
                batch_size=1, pre_dispatch=n_jobs,
            )  # fmt: skip
            calls = [delayed(_numbered)(jobs, *item) for item in missing.items()]
            try:
                for number, result in pool(calls):
                    del missing[number]
                    yield number, result
            except TerminatedWorkerError as error:
                # Those at work beside it are lost with it, the others begin in a new pool.
                begun = [one for one in missing if (jobs.folder / str(one)).exists()]
                for number in begun or list(missing):
                    del missing[number]
                    yield number, error

    return run


def _numbered(jobs: Jobs, number: int, overrides: list[str]) -> tuple[int, JobReturn]:
    return number, jobs.run(number, overrides)


def on_ray(address: str | None, num_cpus: float, num_gpus: float) -> Runner:
    """Return a runner of jobs that occupy so many cores and accelerators of a cluster.

    Args:
        address: The cluster's ``host:port``; None starts one on this machine for these jobs.
        num_cpus: Cores.
        num_gpus: Accelerators; a job sees only its own.
    """

    def run(
        jobs: Jobs, overrides: Mapping[int, list[str]]
    ) -> Iterator[tuple[int, JobReturn | Exception]]:
        ray = connect(address, cpu_count() or 1, "hydra/launcher=ray", "hydra.launcher.address")
        try:
            # Not repeated: a job that took its process down once would do so again. Without SPREAD,
            # Ray fills one machine before it uses the next.
            remote = ray.remote(
                max_retries=0, scheduling_strategy="SPREAD", num_cpus=num_cpus, num_gpus=num_gpus
            )(Jobs.run)
            tasks = {remote.remote(jobs, *item): item[0] for item in overrides.items()}
            waiting = list(tasks)
            while waiting:
                ended, waiting = ray.wait(waiting, num_returns=1)
                for task in ended:
                    try:
                        yield tasks[task], ray.get(task)
                    except ray.exceptions.RayError as error:
                        yield tasks[task], error
        finally:
            ray.shutdown()

    return run
