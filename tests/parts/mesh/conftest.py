from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dopepp.core.errors import UserError
from dopepp.parts import read_mesh

Content = str | bytes


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, Content], Path]:
    """Write a file into the test's folder."""

    def write(name: str, content: Content) -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


@pytest.fixture
def refused(write: Callable[[str, Content], Path]) -> Callable[[str, Content, str], None]:
    """Read a file that must be refused in one line that names it."""

    def refused(name: str, content: Content, match: str) -> None:
        path = write(name, content)
        with pytest.raises(UserError, match=match) as caught:
            read_mesh(path, "mm")
        assert str(path.parent) in str(caught.value)
        assert "\n" not in str(caught.value)

    return refused
