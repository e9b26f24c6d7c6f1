"""``hydra/launcher=joblib|submitit_slurm|ray``: their options are in ``conf/hydra/launcher``."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    from dopepp.experiment.launch.jobs import Runner


class _RemoteLauncher(Launcher):
    """Hands jobs to :func:`dopepp.experiment.launch.jobs.launch`."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Take what Hydra hands to every launcher."""
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs, numbered from ``initial_job_idx``, and wait for all."""
        from dopepp.experiment.launch.jobs import Jobs, launch

        jobs = Jobs.of(self.hydra_context, self.config, self.task_function)
        return launch(jobs, job_overrides, initial_job_idx, self.runner())

    @abstractmethod
    def runner(self) -> Runner:
        """Return what runs the jobs."""


class JoblibLauncher(_RemoteLauncher):
    """Jobs in several processes of this machine."""

    def __init__(self, n_jobs: int) -> None:
        self.n_jobs = n_jobs

    def runner(self) -> Runner:
        """Return what runs the jobs."""
        from dopepp.experiment.launch.jobs import on_joblib

        return on_joblib(self.n_jobs)


class RayLauncher(_RemoteLauncher):
    """Jobs as tasks of a Ray cluster."""

    def __init__(self, address: str | None, num_cpus: float, num_gpus: float) -> None:
        self.address, self.num_cpus, self.num_gpus = address, num_cpus, num_gpus

    def runner(self) -> Runner:
        """Return what runs the jobs."""
        from dopepp.experiment.launch.jobs import on_ray

        return on_ray(self.address, self.num_cpus, self.num_gpus)


class SlurmLauncher(_RemoteLauncher):
    """Jobs as a SLURM job array."""

    def __init__(self, folder: str, cluster: str, max_num_timeout: int, **sbatch: Any) -> None:
        self.folder, self.cluster, self.max_num_timeout = folder, cluster, max_num_timeout
        self.sbatch = {
            key: OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            for key, value in sbatch.items()
        }

    def runner(self) -> Runner:
        """Return what runs the jobs."""
        from dopepp.experiment.launch.slurm import on_slurm

        return on_slurm(self.folder, self.cluster, self.max_num_timeout, self.sbatch)
