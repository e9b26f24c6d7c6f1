"""Strict YAML for untrusted files, such as run folders and camera files.

``yaml.safe_load`` runs no code, but expands anchors to gigabytes and crashes on deep nesting. Here,
these raise :class:`~dopepp.core.errors.UserError`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import yaml

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited

MAX_BYTES: Final = 1_000_000  # fifty times the largest config of a run
MAX_DEPTH: Final = 32


def read_yaml(path: Path) -> object:
    """Read a YAML file of mappings, lists, text, numbers, true/false and null.

    Raises:
        UserError: The file cannot be read, is too large or damaged, has nesting deeper than 32, or
            has an anchor, an alias or a tag.
    """
    try:
        text = read_limited(path, MAX_BYTES).decode("utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise _bad(path, f"unreadable: {reason!s:.200}") from error
    return parse_yaml(text, path)


def parse_yaml(text: str, where: Path | str) -> object:
    """Parse YAML text from a source ``where`` (for messages), like :func:`read_yaml`."""
    try:
        _check_events(text)
        return yaml.safe_load(text)
    except (ValueError, yaml.YAMLError) as error:
        raise _bad(where, f"unreadable: {error!s:.200}") from error


def _check_events(text: str) -> None:
    """Raise a ValueError for deep nesting, anchors, aliases and tags, before the text is loaded."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, yaml.NodeEvent) and event.anchor is not None:
            raise ValueError(f"with YAML aliases ({event.anchor!r:.50})")
        has_tag = (yaml.ScalarEvent, yaml.CollectionStartEvent)
        if isinstance(event, has_tag) and event.tag not in (None, "!"):  # "!": quoted text
            raise ValueError(f"the tag {event.tag!r:.80}")


def _bad(where: Path | str, problem: str) -> UserError:
    allowed = f"YAML of at most {MAX_BYTES / 1e6:g} MB, without anchors and tags"
    return UserError(f"{where}, {problem}", allowed, "write plain YAML, or restore the file")
