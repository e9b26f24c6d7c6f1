from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the real frames, meshes, parts and photos; skips where it is missing."""
    root = Path(os.environ.get("DOPEPP_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"real test data not found in {root}; set DOPEPP_TEST_DATA")
    return root


@pytest.fixture(scope="session")
def ycb_root(shared_data: Path) -> Path:
    return shared_data / "ycb_video_mini"
