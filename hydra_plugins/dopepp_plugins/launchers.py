"""Launchers for ``hydra/launcher=joblib|submitit_slurm|ray``; see ``conf/hydra/launcher``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf


class _RemoteLauncher(Launcher):
    """Hand jobs to the runner that ``function`` of ``sweep.job_runners`` returns."""

    def __init__(self, function: str, *options: object) -> None:
        self.function, self.options = function, options

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the arguments that Hydra passes to every launcher."""
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs, numbered from ``initial_job_idx``, and wait for all."""
        from dopepp.experiment.sweep import job_runners

        common = job_runners.Jobs(self.hydra_context, self.config, self.task_function)
        runner = getattr(job_runners, self.function)(*self.options)
        return job_runners.launch(common, job_overrides, initial_job_idx, runner)


class JoblibLauncher(_RemoteLauncher):
    """Run jobs in several processes of this machine."""

    def __init__(self, n_jobs: int) -> None:
        super().__init__("on_joblib", n_jobs)


class RayLauncher(_RemoteLauncher):
    """Run jobs as tasks of a Ray cluster."""

    def __init__(self, address: str | None, num_cpus: float, num_gpus: float) -> None:
        super().__init__("on_ray", address, num_cpus, num_gpus)


class SlurmLauncher(_RemoteLauncher):
    """Run jobs as a SLURM job array."""

    def __init__(self, folder: str, cluster: str, max_num_timeout: int, **sbatch: Any) -> None:
        is_config, plain = OmegaConf.is_config, OmegaConf.to_container
        given = {key: plain(node) if is_config(node) else node for key, node in sbatch.items()}
        super().__init__("on_slurm", folder, cluster, max_num_timeout, given)
