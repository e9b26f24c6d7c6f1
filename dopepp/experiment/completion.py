"""What may follow on the command line of ``dopepp train`` and ``dopepp evaluate``."""

from __future__ import annotations

import re
from collections.abc import Sequence

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
    with initialize_config_dir(str(CONF), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        found = plugin._query(name, line)
        while len(found) == 1 and found[0].endswith(("=", ".", "/")):
            start = line.rpartition(" ")[0]
            longer = plugin._query(name, f"{start} {found[0]}")
            if longer == found or not longer:
                break
            found = longer
    return [one.rpartition("=")[2] if is_value else one for one in found]
