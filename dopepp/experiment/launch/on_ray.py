"""Jobs as tasks of a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import cpu_count

from hydra.core.utils import JobReturn

from dopepp.data.production.cluster import connect
from dopepp.experiment.launch.jobs import Jobs, Runner


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
