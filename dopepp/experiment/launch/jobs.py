"""What all launchers share: a job in another process, and what is left of one that was lost.

To add a launcher, write a :data:`Runner`, a class in ``hydra_plugins.dopepp_plugins.launchers`` and
a file in ``conf/hydra/launcher``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from dopepp.experiment import display, record


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
