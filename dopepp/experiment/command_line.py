"""The two entry points' shell: from the command line to a plain config, from errors to one line.

Exit codes: 0 done, 1 failed, 2 a user's mistake, 130 interrupted, 143 asked to stop (SIGTERM).
"""

from __future__ import annotations

import difflib
import errno
import logging
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import CONF
from dopepp.core.interrupts import NO_SPACE, Interruption, interruptible
from dopepp.experiment import program
from dopepp.experiment.sweep import remote

# The modules that load PyTorch are imported inside functions: a typo is told before.

_log = logging.getLogger(__name__)

Job = Callable[[dict[str, Any], Path], object]

SHORT_NAMES: Final = {
    "camera": "virtual.camera",
    "working_distance": "virtual.working_distance",
    "max_tilt_deg": "virtual.scene.turning.tilt_deg",
}
"""What options of how a part is seen are called on the command line, and where they stand."""
EVALUATION_SHORT_NAMES: Final = {**SHORT_NAMES, "scale": "scale_factors"}
"""``evaluate.py``'s; ``scale`` alone, without being short for something, would be a file of
``conf/scale``, which chooses a training's sizes."""

FAILED: Final = 1
USERS_MISTAKE: Final = 2

_REFUSALS: Final = (*NO_SPACE, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST)
"""What a disk may answer to any program; another ``OSError`` is one of this program."""


def run_job(config: DictConfig, job: Job) -> float | None:
    """Resolve the config once and run a job in Hydra's run folder.

    In a multirun a failing job leaves ``failed.json``, one that a search has stopped
    ``pruned.json``, and the others run. Returned is the objective of a multirun's training, for
    Hydra's sweepers; None where there is none.

    A run that is refused because of what its user asked for leaves no folder.
    """
    hydra = HydraConfig.get()
    run_dir = Path(hydra.runtime.output_dir)
    if hydra.mode != RunMode.MULTIRUN:
        if remote.is_first_process():
            program.say(f"begins in {program.shown(run_dir)}")
        try:
            # Hydra's own file may be cut in the middle; a resumed run's are kept once accepted.
            resumed = any(text.startswith("resume=") for text in hydra.overrides.task)
            if not resumed:
                from dopepp.experiment.run.resume import remember_overrides

                remember_overrides(run_dir)
                remote.remember_run(sys.argv[1:], run_dir)
            job(_plain(config), run_dir)
        # Here, because Hydra would print a stack before handing it on.
        except (UserError, OmegaConfBaseException) as error:
            if not resumed and remote.is_first_process():
                _remove_unused(run_dir)
            told = error if isinstance(error, UserError) else _explain(error, None)
            _exit(told, USERS_MISTAKE)
        except RunError as error:
            _exit(error, FAILED)
        except OSError as error:
            if error.errno not in _REFUSALS:
                raise
            where = error.filename or run_dir
            _exit(f"cannot write {where}: {error.strerror}; free or repair it", FAILED)
        return None
    if not remote.is_remote(str(hydra.launcher._target_)):
        return _run_one_of_many(config, job, run_dir)
    remote.configure_logging()
    with remote.own_output(run_dir / remote.LOG_FILE):
        return _run_one_of_many(config, job, run_dir)


def _remove_unused(run_dir: Path) -> None:
    """Remove the folder of a refused run, unless it holds more than how it was started."""
    from dopepp.experiment.results.folder import DIFFERENCE, OF_THE_START

    names = {path.name for path in run_dir.iterdir()}
    if all(one in OF_THE_START or one.startswith(DIFFERENCE) for one in names):
        shutil.rmtree(run_dir)
        if not any(run_dir.parent.iterdir()):
            run_dir.parent.rmdir()


def _run_one_of_many(config: DictConfig, job: Job, run_dir: Path) -> float | None:
    """Run a job of a multirun, whose end stands in its folder."""
    from dopepp.experiment.results import display
    from dopepp.experiment.results.folder import FAILURE_FILE, OBJECTIVE, PRUNED_FILE, write_json
    from dopepp.experiment.results.report import Report
    from dopepp.experiment.sweep.multirun import compare_jobs
    from dopepp.training.callbacks.trial import PrunedError

    for name in (FAILURE_FILE, PRUNED_FILE):  # of an attempt before this one
        (run_dir / name).unlink(missing_ok=True)
    try:
        plain = _plain(config)
        if remote.goes_on(plain, run_dir):
            plain["resume"] = str(run_dir)
        result = job(plain, run_dir)
        return result.details.get(OBJECTIVE) if isinstance(result, Report) else None
    except KeyboardInterrupt:
        if not remote.is_remote(str(HydraConfig.get().launcher._target_)):
            # What is finished: Hydra ends without its hook.
            compare_jobs(Path(HydraConfig.get().sweep.dir), config)
        raise
    except PrunedError as end:
        display.console.print(f"pruned {end}")
        write_json(run_dir / PRUNED_FILE, {"reason": str(end)})
    except Exception as error:
        reason = " ".join(str(error).split()) or repr(error)
        expected = isinstance(error, (UserError, RunError))
        number = HydraConfig.get().job.num
        _log.error("job %s failed: %s", number, reason, exc_info=not expected)
        run_dir.mkdir(parents=True, exist_ok=True)
        write_json(run_dir / FAILURE_FILE, {"reason": reason})
    return None


def _plain(config: DictConfig) -> dict[str, Any]:
    """Resolve every interpolation; below this line there are only plain values."""
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return dict(plain)


def entry(
    main: Callable[[], object],
    open_nodes: Sequence[str] = (),
    short_names: Mapping[str, str] | None = None,
    num_words: int = 1,
) -> None:
    """Run an entry point and exit with its code; a user's mistake is printed as one line.

    ``main`` hands ``sys.argv`` to Hydra, but for the ``num_words`` of the program. Keys of the open
    nodes are not in ``conf/`` but checked later, so that they can be set without Hydra's ``+``:
    ``virtual.scene`` takes any field of a preset. ``short_names`` is what options may be called
    instead of their names.
    """
    # Hydra would print its own pages of text and exit with 1; so it hands its errors on instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    remote.configure_logging()
    try:
        words, given = sys.argv[:num_words], sys.argv[num_words:]
        arguments = [_spelled_out(text, short_names or {}, open_nodes) for text in given]
        begun = remote.begun_run([*words[1:], *arguments])
        if begun is not None:
            arguments.append(f"resume={begun}")
        _refuse_used_folder(arguments)
        sys.argv = [*words, *_resumed(arguments)]
        with interruptible("start the command again"):
            main()
    except Interruption as interruption:
        line = str(interruption)
        first = remote.is_first_process()
        if interruption.number == signal.SIGTERM and remote.job_id() is not None and first:
            line = f"{line}; {remote.requeue()}"
        _exit(line, interruption.exit_code)
    except (HydraException, OmegaConfBaseException) as error:  # one of Hydra's is an OSError, too
        _exit(_explain(error, CONF), USERS_MISTAKE)
    except OSError as error:  # the jobs' own are dealt with: what is left is Hydra's
        if error.errno not in _REFUSALS:
            raise
        allowed, fix = "a folder that can be written", "set output_dir=…, or make it writable"
        got = f"output folder {error.filename}: {error.strerror}"
        _exit(UserError(got, allowed, fix), USERS_MISTAKE)
    except UserError as error:  # of a sweeper or launcher; jobs deal with their own
        _exit(error, USERS_MISTAKE)


def _exit(line: object, code: int) -> None:
    sys.stdout.flush()
    sys.stderr.write(f"{line}\n")
    raise SystemExit(code)


def _spelled_out(argument: str, short_names: Mapping[str, str], open_nodes: Sequence[str]) -> str:
    """Call an option by its name, and let it add a key where that is allowed."""
    key, equals, value = argument.partition("=")
    named = f"{short_names.get(key, key)}{equals}{value}"
    inside = named.startswith(tuple(f"{node}." for node in open_nodes))
    return f"++{named}" if inside else named


def _refuse_used_folder(arguments: Sequence[str]) -> None:
    """Refuse to begin a run where another one is, before Hydra writes there.

    The further processes of a run get its folder from the first one.
    """
    words = dict(text.partition("=")[::2] for text in arguments)
    folder = words.get("hydra.run.dir", "")
    if not folder or words.get("resume", "null") not in ("", "null"):
        return
    from dopepp.experiment.results.folder import VERSIONS_FILE

    if Path(folder, VERSIONS_FILE).is_file() and remote.is_first_process():
        raise UserError(
            f"hydra.run.dir={folder}, which holds a run",
            "a folder without one",
            f"choose another folder, or go on with resume={folder}",
        )


def _resumed(arguments: list[str]) -> list[str]:
    """For ``resume=RUN``, put the run's own overrides first and go on in its folder."""
    runs = [text.partition("=")[2] for text in arguments if text.startswith("resume=")]
    if not runs or runs[-1] in ("", "null"):
        return arguments
    from dopepp.experiment.run.resume import read_overrides

    run = Path(runs[-1])
    overrides = read_overrides(run)
    if overrides is None:
        return arguments  # the run itself says what is wrong with the folder
    # No file of the run changes before it is known whether it may go on like this.
    return [*overrides, *arguments, f"hydra.run.dir={run}", "hydra.output_subdir=null"]


def _explain(error: Exception, config_dir: Path | None) -> UserError:
    """Turn Hydra's or OmegaConf's message into one line with got, allowed and fix."""
    text = " ".join(f"{error} {error.__cause__ or ''}".split())
    if found := re.search(r"Could not override '([^']+)'", text):
        key = found.group(1)
        allowed = "the options of `--cfg job`" + _nearest(key, config_dir)
        return UserError(f"override {key!r}, which names no option", allowed, "check the spelling")
    choice = r"Could not find '([^']+)' Available options in '([^']+)': (.*?) Config"
    if found := re.search(choice, text):
        name, group, available = found.groups()
        return UserError(f"{group}={name.rpartition('/')[2]}", available, "choose one of them")
    if found := re.search(r"Missing mandatory value: (\S+)", text):
        key = found.group(1)
        return UserError(f"no {key}", f"{key}=… on the command line", f"add {key}=…")
    return UserError(text, "overrides as `key=value`", "see `--help`")


def _nearest(key: str, config_dir: Path | None) -> str:
    """Name the option that was probably meant, or the program that has this one."""
    if config_dir is None:
        return ""
    with initialize_config_dir(str(config_dir.resolve()), version_base="1.3"):
        options = {name: set(_flat(compose(name))) for name in ("train", "evaluate")}
    for name, known in options.items():
        if key in known:
            return f"; it is one of {name}.py"
    close = difflib.get_close_matches(key, sorted(set().union(*options.values())), n=1)
    return f", nearest {close[0]}" if close else ""


def _flat(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """Yield every option of a config in dotted form, groups included."""
    for key in node:
        yield f"{prefix}{key!s}"
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            yield from _flat(child, f"{prefix}{key!s}.")
