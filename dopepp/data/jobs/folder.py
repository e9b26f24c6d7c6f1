"""The folder of a render job: its record, and what killed processes left in it.

The record is written into the folder first; whoever comes later with another one is refused, by
the fields that differ.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.files import PARTIAL_SUFFIX, is_abandoned, partial_path, write_whole
from dopepp.core.interrupts import NO_SPACE, stopped
from dopepp.core.json import read_json

RECORD_FILE: Final = "_dopepp_render.json"
"""The underscore is NDDS's mark of a settings file: without it, readers of that layout would take
the record for an image's annotation."""

_MAX_RECORD_BYTES: Final = 4_000_000
"""Some 10,000 parts."""

_MAX_DIFFERENCES: Final = 3
"""As many as one line can hold."""


def is_begun(root: Path) -> bool:
    """Tell whether a job has claimed the folder."""
    return (root / RECORD_FILE).is_file()


def begin(root: Path, record: Mapping[str, Any]) -> None:
    """Claim a folder for a job, or find that it is this job's already, and clean it.

    Raises:
        UserError: The folder cannot be written, holds another job or something else.
        StoppedError: There is no space left.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        _claim(root, json.loads(json.dumps(record)))
        _remove_abandoned(root)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise stopped(error, root) from error
        raise UserError(
            f"folder {root}: {error.strerror}", "a folder that can be written", "choose another"
        ) from error


def _claim(root: Path, record: Mapping[str, Any]) -> None:
    path = root / RECORD_FILE
    # Listed before the record is looked for: what another shard has made came after its record.
    names = sorted(entry.name for entry in root.iterdir())
    if not path.exists():
        foreign = [name for name in names if not name.endswith(PARTIAL_SUFFIX)]
        if foreign:
            raise UserError(
                f"folder {root}, which holds {foreign[0]!r} and no {RECORD_FILE}",
                "an empty folder, or one that a render job began",
                "choose another folder",
            )
        write_whole(path, (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    # Also after writing: two jobs may have begun in the same moment.
    differences = list(_differences(read_json(path, _MAX_RECORD_BYTES), record, ""))
    if differences:
        raise UserError(
            f"{path} of another job: {', '.join(differences[:_MAX_DIFFERENCES])}",
            "the settings that the folder was begun with",
            "repeat those settings with that version of dopepp, or choose another folder",
        )


def _differences(there: object, now: object, where: str) -> Iterator[str]:
    """Yield every field that differs, with both values."""
    if isinstance(there, dict) and isinstance(now, dict):
        for key in now | there:
            field = f"{where}.{key}" if where else str(key)
            yield from _differences(there.get(key), now.get(key), field)
    elif isinstance(there, list) and isinstance(now, list) and len(there) == len(now):
        for number, pair in enumerate(zip(there, now, strict=True)):
            yield from _differences(*pair, f"{where}[{number}]")
    elif there != now:
        texts = (json.dumps(value) for value in (there, now))
        before, after = (text if len(text) <= 60 else f"{text[:57]}..." for text in texts)
        yield f"{where or 'content'} is {before} there and {after} now"


def _remove_abandoned(root: Path) -> None:
    """Remove the partial files that killed processes left, but none of a running shard."""
    clock = partial_path(root / "clock")
    clock.touch()
    now = clock.stat().st_mtime
    clock.unlink()
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder, name)
            if name.endswith(PARTIAL_SUFFIX) and is_abandoned(path, now):
                path.unlink(missing_ok=True)
