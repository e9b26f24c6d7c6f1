"""Strict YAML: what anybody may have written (a run folder, a camera file), read within bounds.

``yaml.safe_load`` runs no code, but follows anchors to a list that stands for gigabytes and dies
of deep nesting; here each of these is a :class:`~dopepp.core.errors.UserError`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import yaml

from dopepp.core.errors import UserError

MAX_BYTES: Final = 1_000_000  # Fifty times the largest config of a run
MAX_DEPTH: Final = 32


def read_yaml(path: Path) -> object:
    """Read a YAML file of mappings, lists, text, numbers, true/false and null.

    Raises:
        UserError: The file cannot be read, is too large or damaged, is nested more than 32 deep, or
            has an anchor, an alias or a tag.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise _bad(path, f"of {path.stat().st_size} bytes")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise _bad(path, f"unreadable: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise _bad(path, f"unreadable: {error!s:.200}") from error
    return parse_yaml(text, path)


def parse_yaml(text: str, where: Path | str) -> object:
    """Parse YAML text of a size its caller bounds; a :class:`UserError` as from `read_yaml`."""
    try:
        _check_events(text)
        return yaml.safe_load(text)
    except (ValueError, yaml.YAMLError) as error:
        raise _bad(where, f"unreadable: {error!s:.200}") from error


def _check_events(text: str) -> None:
    """Go through a text's structure before anything is made of it."""
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


def _bad(where: Path | str, got: str) -> UserError:
    allowed = f"YAML of at most {MAX_BYTES / 1e6:g} MB, without anchors and tags"
    return UserError(f"{where}, {got}", allowed, "use a file that you trust, or restore it")
