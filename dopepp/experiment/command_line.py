"""Prepare the command line for Hydra, explain Hydra's errors and complete words in a shell."""

from __future__ import annotations

import difflib
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.completion_plugin import DefaultCompletionPlugin
from omegaconf import DictConfig

from dopepp.core.errors import UserError
from dopepp.core.files import CONF
from dopepp.core.yaml import read_yaml
from dopepp.experiment import program
from dopepp.experiment.sweep import multirun

# Modules that load PyTorch are imported inside functions, so typing errors are reported at once.

SHORT_NAMES: Final = {
    "camera": "virtual.camera",
    "working_distance": "virtual.working_distance",
    "max_tilt_deg": "virtual.scene.turning.tilt_deg",
}
"""Full option name by short name, for ``train.py``."""
EVALUATION_SHORT_NAMES: Final = {**SHORT_NAMES, "scale": "scale_factors"}
"""Short names for ``evaluate.py``. For training, ``scale`` selects a file of ``conf/scale``."""


def prepare(open_nodes: Sequence[str], short_names: Mapping[str, str], num_words: int) -> None:
    """Expand short names in ``sys.argv``, and add the overrides of a run that is resumed.

    The records of a run and its worker processes use the rewritten list. Hydra interpolations
    cannot replace short names, because both options would appear in the config.

    Args:
        open_nodes: Config nodes that accept keys missing in ``conf/``, which are checked later.
        short_names: Full option name by short name.
        num_words: Number of words before the overrides: 1 for ``train.py``, 2 for ``dopepp train``.
    """
    words, arguments = sys.argv[:num_words], []
    for argument in sys.argv[num_words:]:
        key, equals, value = argument.partition("=")
        named = f"{short_names.get(key, key)}{equals}{value}"
        is_inside = named.startswith(tuple(f"{node}." for node in open_nodes))
        arguments.append(f"++{named}" if is_inside else named)
    begun = multirun.requeued_run([*words[1:], *arguments])
    if begun is not None:
        arguments.append(f"resume={begun}")
    given = dict(text.partition("=")[::2] for text in arguments)
    resume, folder = given.get("resume", "null"), given.get("hydra.run.dir", "")
    if resume not in ("", "null"):
        arguments = _resumed(arguments, Path(resume))
    elif folder:
        _refuse_used_folder(folder)
    if "hydra.sweep.dir" in given and "search" not in given:
        _refuse_other_multirun(given["hydra.sweep.dir"], arguments)
    sys.argv = [*words, *arguments]


def _refuse_used_folder(folder: str) -> None:
    from dopepp.experiment.results.folder import VERSIONS_FILE

    # Processes of higher rank receive the folder that rank 0 has created.
    if Path(folder, VERSIONS_FILE).is_file() and program.is_first_process():
        raise UserError(
            f"hydra.run.dir={folder}, which holds a run",
            "a folder without a run",
            f"set another folder, or continue with resume={folder}",
        )


def _refuse_other_multirun(folder: str, arguments: Sequence[str]) -> None:
    """Raise a UserError if a folder holds a multirun with other options, to keep its jobs."""
    from dopepp.experiment.run.resume import task_overrides

    path = Path(folder, "multirun.yaml")
    stored = task_overrides(read_yaml(path)) if path.is_file() else None
    given = [text for text in arguments if text[0] != "-" and ("=" in text or text[0] == "~")]
    present = [text for text in given if not text.lstrip("~+").startswith(("hydra.", "hydra/"))]
    if isinstance(stored, list) and (changed := set(map(str, stored)) ^ set(present)):
        raise UserError(
            f"hydra.sweep.dir={folder}, which holds a multirun that differs in "
            f"{', '.join(sorted(changed))}",
            "the options of that multirun, or a folder without jobs",
            "repeat its command to continue it, or leave out hydra.sweep.dir",
        )


def _resumed(arguments: list[str], run: Path) -> list[str]:
    """Add the stored overrides of the resumed ``run``, which becomes the run folder."""
    from dopepp.experiment.run.resume import read_overrides

    overrides = read_overrides(run)
    if overrides is None:
        return arguments  # the run reports the problem with the folder
    # Hydra must not write into the run before the checks of resuming have passed. The experiment of
    # a multirun's job may select the mode MULTIRUN, but the job is resumed by itself.
    fixed = [f"hydra.run.dir={run}", "hydra.output_subdir=null", "hydra.mode=RUN"]
    # Hydra's parser rejects overrides on both sides of an option such as --cfg.
    first = next(i for i, text in enumerate(arguments) if "=" in text and text[0] != "-")
    given = [text for text in arguments[first:] if not text.startswith("hydra.run.dir=")]
    return [*arguments[:first], *overrides, *fixed, *given]


def convert_error(error: Exception) -> UserError:
    """Convert a Hydra or OmegaConf error into a UserError with allowed values and a fix."""
    text = " ".join(f"{error} {error.__cause__ or ''}".split())
    if match := re.search(r"Could not override '([^']+)'", text):
        key = match.group(1)
        allowed = "the options of `--cfg job`" + _nearest(key)
        fix = "correct the name; --cfg job prints all options"
        return UserError(f"override {key!r}, which names no option", allowed, fix)
    choice = r"Could not find '([^']+)' Available options in '([^']+)': (.*?) Config"
    if match := re.search(choice, text):
        name, group, available = match.groups()
        fix = f"set {group} to one of these names"
        return UserError(f"{group}={name.rpartition('/')[2]}", available, fix)
    if match := re.search(r"Missing mandatory value: (\S+)", text):
        key = match.group(1)
        return UserError(f"no {key}", f"{key}=… on the command line", f"add {key}=…")
    return UserError(
        text, "overrides as `key=value`", "correct the override; --help shows examples"
    )


def _nearest(key: str) -> str:
    """Return a hint on an unknown option: the script that has it, or the most similar name."""
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        options = {name: set(_flat(compose(name))) for name in ("train", "evaluate")}
    for name, names in options.items():
        if key in names:
            return f"; {key} is an option of {name}.py"
    close = difflib.get_close_matches(key, sorted(set().union(*options.values())), n=1)
    return f", nearest {close[0]}" if close else ""


def _flat(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of all keys of a config, including nodes, after ``prefix``."""
    for key in node:
        yield f"{prefix}{key!s}"
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            yield from _flat(child, f"{prefix}{key!s}.")


def complete(name: str, words: Sequence[str], incomplete: str) -> list[str]:
    """Return the completions of the word at the cursor for a shell, after ``words``.

    A single matching key is completed to its values, because a shell adds a space to a single
    match. After the word ``=``, only values are returned, because Bash splits words at ``=``.
    """
    line = re.sub(r" ?= ?", "=", " ".join([*words, incomplete]))
    is_value = list(words[-1:]) == ["="]
    if "virtual.scene." in line:
        line = f"{_scene(line.split())} {line}"
    with initialize_config_dir(str(CONF), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        matches = plugin._query(name, line)
        while len(matches) == 1 and matches[0].endswith(("=", ".", "/")):
            start = line.rpartition(" ")[0]
            longer = plugin._query(name, f"{start} {matches[0]}")
            if longer == matches or not longer:
                break
            matches = longer
    return [match.rpartition("=")[2] if is_value else match for match in matches]


def _scene(words: Sequence[str]) -> str:
    """Return a ``virtual.scene`` override with the fields of the preset that ``words`` select."""
    from dopepp.virtual.presets import PRESETS

    given = [word.partition("=")[2] for word in words if word.startswith("virtual.preset=")]
    preset = PRESETS[given[-1] if given and given[-1] in PRESETS else "paper"]
    fields = json.dumps(asdict(preset), separators=(",", ":")).replace('"', "")
    return f"++virtual.scene={fields}"
