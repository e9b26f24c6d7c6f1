"""Jobs in several processes of this machine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from hydra.core.utils import JobReturn

from dopepp.experiment.extras import require
from dopepp.experiment.launch.jobs import Jobs, Runner
from dopepp.models.gate import check_integer

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
