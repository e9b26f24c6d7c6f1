"""The two entry points: ``train.py`` or ``dopepp train``, ``evaluate.py`` or ``dopepp evaluate``.

From a command to a plain config, and from errors to one line. What takes long to import is imported
once a job has its folder and has said so.

Exit codes: 0 done, 1 failed, 2 a user's mistake, 130 interrupted, 143 asked to stop (SIGTERM).
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
from typing import Any, Final

from hydra import version

# hydra.main reads sys.argv itself, where `dopepp train` has a word more than Hydra knows.
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
"""What is done with a plain config in a run's folder."""

FAILED: Final = 1
USERS_MISTAKE: Final = 2

_REFUSALS: Final = (*NO_SPACE, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST)
"""What a disk may answer to any program; another ``OSError`` is one of this program."""


def train(config: DictConfig) -> float | None:
    """Run one job and return what a search maximises."""

    def job(plain: Mapping[str, Any], run_dir: Path) -> object:
        from dopepp.experiment.run.train import do_job

        return do_job(plain, run_dir)

    return run_job(config, job)


def evaluate(config: DictConfig) -> None:
    """Run one evaluation."""

    def job(plain: Mapping[str, Any], run_dir: Path) -> object:
        from dopepp.experiment.run.evaluate import run_evaluation

        return run_evaluation(plain, run_dir)

    run_job(config, job)


_ENTRIES: Final = {
    "train": (train, ["virtual.scene"], command_line.SHORT_NAMES),
    "evaluate": (evaluate, ["data", "virtual"], command_line.EVALUATION_SHORT_NAMES),
}
"""By name: what Hydra calls, nodes that take keys which ``conf/`` does not name, short names."""


def start(name: str, num_words: int = 1) -> None:
    """Run ``train`` or ``evaluate`` as the command line says, and exit with its code.

    Its first ``num_words`` words are the program: ``train.py``, or ``dopepp train``.
    """
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
    """Run what hands ``sys.argv`` to Hydra and exit with its code.

    A user's mistake is printed as one line. The arguments are those of
    :func:`~dopepp.experiment.command_line.prepare`.
    """
    # Hydra would print its own pages of text and exit with 1; so it hands its errors on instead.
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
        _exit(line, interruption.exit_code)
    except (HydraException, OmegaConfBaseException) as error:  # one of Hydra's is an OSError, too
        _exit(command_line.explain(error), USERS_MISTAKE)
    except OSError as error:  # the jobs' own are dealt with: what is left is Hydra's
        if error.errno not in _REFUSALS:
            raise
        allowed, fix = "a folder that can be written", "set output_dir=…, or make it writable"
        problem = f"output folder {error.filename}: {error.strerror}"
        _exit(UserError(problem, allowed, fix), USERS_MISTAKE)
    except UserError as error:  # of a sweeper or launcher; jobs deal with their own
        _exit(error, USERS_MISTAKE)


def _exit(line: object, code: int) -> None:
    sys.stdout.flush()
    sys.stderr.write(f"{line}\n")
    raise SystemExit(code)


def run_job(config: DictConfig, job: Job) -> float | None:
    """Resolve the config once and run a job in Hydra's run folder.

    In a multirun a failing job leaves ``failed.json``, one that a search has stopped
    ``pruned.json``, and the others run. Returned is the objective of a multirun's training, for
    Hydra's sweepers; None where there is none.

    A run that is refused because of what its user asked for leaves no folder.
    """
    hydra = HydraConfig.get()
    run_dir = Path(hydra.runtime.output_dir)
    if hydra.mode == RunMode.MULTIRUN:
        if not multirun.is_remote(hydra):
            return _run_one_of_many(config, job, run_dir)
        program.configure_logging()
        with multirun.own_output(run_dir / multirun.LOG_FILE):
            return _run_one_of_many(config, job, run_dir)
    if program.is_first_process():
        program.say(f"begins in {program.shown(run_dir)}")
    # Hydra's own file may be cut in the middle; a resumed run's are kept once accepted.
    resumed = any(text.startswith("resume=") for text in hydra.overrides.task)
    try:
        if not resumed:
            from dopepp.experiment.run.resume import remember_overrides

            remember_overrides(run_dir)
            multirun.remember_run(sys.argv[1:], run_dir)
        job(_plain(config), run_dir)
    # Here, because Hydra would print a stack before handing it on.
    except (UserError, OmegaConfBaseException) as error:
        if not resumed and program.is_first_process():
            _remove_unused(run_dir)
        mistake = error if isinstance(error, UserError) else command_line.explain(error)
        _exit(mistake, USERS_MISTAKE)
    except RunError as error:
        _exit(error, FAILED)
    except OSError as error:
        if error.errno not in _REFUSALS:
            raise
        where = error.filename or run_dir
        _exit(f"cannot write {where}: {error.strerror}; free or repair it", FAILED)
    return None


def _remove_unused(run_dir: Path) -> None:
    """Remove the folder of a refused run, unless it holds more than how it was started."""
    from dopepp.experiment.results.folder import DIFFERENCE, OF_THE_START

    names = {path.name for path in run_dir.iterdir()}
    if all(name in OF_THE_START or name.startswith(DIFFERENCE) for name in names):
        shutil.rmtree(run_dir)
        if not any(run_dir.parent.iterdir()):
            run_dir.parent.rmdir()


def _run_one_of_many(config: DictConfig, job: Job, run_dir: Path) -> float | None:
    """Run a job of a multirun, whose end stands in its folder."""
    from dopepp.experiment.results import display
    from dopepp.experiment.results.folder import FAILURE_FILE, OBJECTIVE, PRUNED_FILE, write_json
    from dopepp.experiment.results.report import Report
    from dopepp.training.pruning import PrunedError

    hydra = HydraConfig.get()
    for name in (FAILURE_FILE, PRUNED_FILE):  # of an attempt before this one
        (run_dir / name).unlink(missing_ok=True)
    try:
        plain = _plain(config)
        if multirun.goes_on(plain, run_dir):
            plain["resume"] = str(run_dir)
        result = job(plain, run_dir)
        return result.details.get(OBJECTIVE) if isinstance(result, Report) else None
    except KeyboardInterrupt:
        if not multirun.is_remote(hydra):
            # What is finished: Hydra ends without its hook.
            multirun.compare_jobs(Path(hydra.sweep.dir), config)
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
    """Resolve every interpolation; below this line there are only plain values."""
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return dict(plain)
