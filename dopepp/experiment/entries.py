"""Entry points of ``train.py`` (``dopepp train``) and ``evaluate.py`` (``dopepp evaluate``).

The module passes the config to the job as a dictionary, and prints each expected error as one line.
Slow imports happen only after a job has printed its folder.

Exit codes: 0 success, 1 failure, 2 user error, 130 interrupted, 143 terminated (SIGTERM).
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final

from hydra import version

# hydra.main reads sys.argv itself, but `dopepp train` has one word more than Hydra expects.
from hydra._internal.utils import _run_hydra, get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dopepp.core.errors import NO_SPACE, Interruption, RunError, UserError, interruptible
from dopepp.core.files import CONF
from dopepp.experiment import command_line, program
from dopepp.experiment.sweep import multirun

_log = logging.getLogger(__name__)

Job = Callable[[dict[str, Any], Path], object]
"""Function that runs a job, given its resolved config and its run folder."""

_REFUSALS: Final = (*NO_SPACE, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST)
"""Numbers of ``OSError`` for a full, read-only or inaccessible location; others are bugs."""


def train(config: DictConfig) -> float | None:
    """Run one job of ``train.py``; return its best validation score in a multirun, else None."""
    return run_job(config, _imported("dopepp.experiment.run.train:do_job"))


def evaluate(config: DictConfig) -> None:
    """Run the evaluation that the config of ``evaluate.py`` describes."""
    run_job(config, _imported("dopepp.experiment.run.evaluate:run_evaluation"))


def _imported(name: str) -> Job:
    """Return a job that imports ``name`` (module:function) only when it runs, for a fast start."""
    return lambda config, run_dir: resolve_name(name)(config, run_dir)


_ENTRIES: Final = {
    "train": (train, ["virtual.scene"], command_line.SHORT_NAMES),
    "evaluate": (evaluate, ["data", "virtual"], command_line.EVALUATION_SHORT_NAMES),
}
"""Hydra task, nodes that accept keys missing in ``conf/``, and short names of each program."""


def start(name: str, num_words: int = 1) -> None:
    """Run ``train`` or ``evaluate``; for ``num_words``, see :func:`.command_line.prepare`."""
    task, open_nodes, short_names = _ENTRIES[name]

    def main() -> None:
        version.setbase("1.3")
        parser = get_args_parser()
        _run_hydra(
            args=parser.parse_args(sys.argv[num_words:]),
            args_parser=parser,
            task_function=task,
            config_path=str(CONF),
            config_name=name,
        )

    entry(main, open_nodes, short_names, num_words)


def entry(
    main: Callable[[], object],
    open_nodes: Sequence[str] = (),
    short_names: Mapping[str, str] | None = None,
    num_words: int = 1,
) -> None:
    """Run ``main``, which passes ``sys.argv`` to Hydra; exit with one line on an expected error."""
    # With this variable Hydra raises its errors instead of printing pages of text.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    program.configure_logging()
    try:
        command_line.prepare(open_nodes, short_names or {}, num_words)
        with interruptible("start the command again"):
            main()
    except Interruption as interruption:
        line = str(interruption)
        first = program.is_first_process()
        if interruption.number == signal.SIGTERM and multirun.job_id() is not None and first:
            line = f"{line}; {multirun.requeue()}"
        _exit(interruption, line)
    except (HydraException, OmegaConfBaseException) as error:  # some HydraExceptions are OSErrors
        _exit(command_line.convert_error(error))
    except OSError as error:  # jobs handle their own errors, so this is an error of Hydra
        if error.errno not in _REFUSALS:
            raise
        allowed, fix = "a folder that can be written", "set output_dir=FOLDER, or make it writable"
        problem = f"output folder {error.filename}: {error.strerror}"
        _exit(UserError(problem, allowed, fix))
    except UserError as error:  # raised by a sweeper or launcher: jobs handle their errors
        _exit(error)


def _exit(error: UserError | RunError | Interruption, line: str = "") -> None:
    sys.stdout.flush()
    sys.stderr.write(f"{line or error}\n")
    raise SystemExit(error.exit_code)


def run_job(config: DictConfig, job: Job) -> float | None:
    """Resolve the config and run a job in Hydra's run folder.

    In a multirun, a failing job writes ``failed.json`` and a pruned trial ``pruned.json``; the
    other jobs continue. After a user error, the folder of a new single run is removed if it has no
    results, also beside ``resume=`` with a folder that is no run.

    Returns:
        In a multirun, the validation score of the run's best checkpoint, else None.
    """
    hydra = HydraConfig.get()
    run_dir = Path(hydra.runtime.output_dir)
    if hydra.mode == RunMode.MULTIRUN:
        if not multirun.is_remote(hydra):
            return _run_one_of_many(config, job, run_dir)
        program.configure_logging()
        with multirun.redirected_output(run_dir / multirun.LOG_FILE):
            return _run_one_of_many(config, job, run_dir)
    if program.is_first_process():
        program.print_line(f"begins in {program.relative_path(run_dir)}")
    # Hydra's own file may be truncated. A resumed run stores its overrides after the checks.
    given = [text for text in hydra.overrides.task if text.startswith("resume=")]
    resumed = Path(given[-1].partition("=")[2]) if given else None
    try:
        if resumed is None:
            from dopepp.experiment.run.resume import remember_overrides

            remember_overrides(run_dir)
            multirun.record_run(sys.argv[1:], run_dir)
        job(_plain(config), run_dir)
    # Errors are handled here because Hydra would print a stack trace.
    except (UserError, OmegaConfBaseException) as error:
        is_new = resumed is None or not (resumed.exists() and resumed.samefile(run_dir))
        if is_new and program.is_first_process():
            _remove_unused(run_dir)
        _exit(error if isinstance(error, UserError) else command_line.convert_error(error))
    except RunError as error:
        _exit(error)
    except OSError as error:
        if error.errno not in _REFUSALS:
            raise
        where = error.filename or run_dir
        _exit(RunError(f"cannot write {where}: {error.strerror}; free or repair it"))
    return None


def _remove_unused(run_dir: Path) -> None:
    """Remove a run folder that holds only files written before the work began."""
    from dopepp.experiment.results.folder import OF_THE_START

    if all(path.name in OF_THE_START for path in run_dir.iterdir()):
        shutil.rmtree(run_dir)
        if not any(run_dir.parent.iterdir()):
            run_dir.parent.rmdir()


def _run_one_of_many(config: DictConfig, job: Job, run_dir: Path) -> float | None:
    """Run or continue a job of a multirun, as described in :func:`run_job`."""
    from dopepp.experiment.results import display
    from dopepp.experiment.results.folder import FAILURE_FILE, OBJECTIVE, PRUNED_FILE, write_json
    from dopepp.experiment.results.report import Report
    from dopepp.training.pruning import PrunedError

    hydra = HydraConfig.get()
    for name in (FAILURE_FILE, PRUNED_FILE):  # remove the markers of an earlier attempt
        (run_dir / name).unlink(missing_ok=True)
    try:
        plain = _plain(config)
        if multirun.can_resume(plain, run_dir):
            plain["resume"] = str(run_dir)
        result = job(plain, run_dir)
        return result.details.get(OBJECTIVE) if isinstance(result, Report) else None
    except KeyboardInterrupt:
        if not multirun.is_remote(hydra):
            # Hydra skips the callback CompareJobs, so the finished jobs are compared here.
            multirun.compare_jobs(Path(hydra.sweep.dir), config, interrupted=True)
        raise
    except PrunedError as end:
        display.console.print(f"pruned {end}")
        write_json(run_dir / PRUNED_FILE, {"reason": str(end)})
    except Exception as error:
        reason = " ".join(str(error).split()) or repr(error)
        expected = isinstance(error, (UserError, RunError))
        _log.error("job %s failed: %s", hydra.job.num, reason, exc_info=not expected)
        run_dir.mkdir(parents=True, exist_ok=True)
        write_json(run_dir / FAILURE_FILE, {"reason": reason})
    return None


def _plain(config: DictConfig) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return dict(plain)
