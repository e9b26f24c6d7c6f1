"""Which code renders: two versions of it may draw the same scene differently."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Final

_PACKAGE: Final = Path(__file__).parents[1]
_FOLDERS: Final = ("virtual", "parts", "geometry")
"""The packages that decide a render's pixels and labels."""


@cache
def code_hash() -> str:
    """Return a SHA-256 of the rendering code; kept renders of other code are not reused."""
    digest = hashlib.sha256()
    for folder in _FOLDERS:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()
