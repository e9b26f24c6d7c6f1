"""What may follow on the command line of ``dopepp train`` and ``dopepp evaluate``."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.completion_plugin import DefaultCompletionPlugin

from dopepp.core.files import CONF


def complete(name: str, words: Sequence[str], incomplete: str) -> list[str]:
    """Return what a shell may put in place of an incomplete word.

    ``name`` is the entry's, ``words`` stand before. A key with one choice left is offered with its
    values, because a shell ends a single match with a space. Bash takes ``=`` for a word of its
    own and replaces only what follows.
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
    """Return an override that writes out the preset's fields, which ``conf/`` does not list."""
    from dopepp.virtual.presets import PRESETS

    given = [word.partition("=")[2] for word in words if word.startswith("virtual.preset=")]
    preset = PRESETS[given[-1] if given and given[-1] in PRESETS else "paper"]
    fields = json.dumps(asdict(preset), separators=(",", ":")).replace('"', "")
    return f"++virtual.scene={fields}"
