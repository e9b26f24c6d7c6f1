"""Jobs as one SLURM job array, through submitit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from hydra.core.utils import JobReturn

from dopepp.errors import UserError
from dopepp.experiment.extras import require
from dopepp.experiment.launch.jobs import Jobs, Runner

_ANYWHERE: Final = ("timeout_min", "nodes", "tasks_per_node", "cpus_per_task", "gpus_per_node",
                    "mem_gb", "name")  # fmt: skip
"""What submitit calls by these names on every kind of cluster; the rest is SLURM's own."""


@dataclass(frozen=True)
class _Task:
    """A job that submitit can queue again."""

    jobs: Jobs

    def __call__(self, number: int, overrides: list[str]) -> JobReturn:
        return self.jobs.run(number, overrides)

    def checkpoint(self, number: int, overrides: list[str]) -> Any:
        """Near the time limit: the same job once more, which goes on in its folder."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, number, overrides)


def on_slurm(folder: str, cluster: str, max_num_timeout: int, sbatch: Mapping[str, Any]) -> Runner:
    """Return a runner that submits an array and waits for it.

    Args:
        folder: Of SLURM's own logs.
        cluster: ``slurm``, or submitit's ``local``: processes of this machine.
        max_num_timeout: How often a job that reaches its time limit is queued again.
        sbatch: Options of sbatch by submitit's names; None leaves one to the cluster.

    Raises:
        UserError: submitit is not installed.
    """
    require("submitit", "hydra/launcher=submitit_slurm", "slurm")
    named = {
        key if key in _ANYWHERE else f"slurm_{key}": value
        for key, value in sbatch.items()
        if value is not None
    }

    def run(
        jobs: Jobs, overrides: Mapping[int, list[str]]
    ) -> Iterator[tuple[int, JobReturn | Exception]]:
        import submitit

        try:
            executor = submitit.AutoExecutor(
                folder, cluster=cluster, slurm_max_num_timeout=max_num_timeout
            )
            executor.update_parameters(**named)
            handles = executor.map_array(_Task(jobs), *zip(*overrides.items(), strict=True))
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
            except (submitit.core.utils.UncompletedJobError,
                    submitit.core.utils.FailedJobError) as error:  # fmt: skip
                yield numbers[handle.job_id], error

    return run
