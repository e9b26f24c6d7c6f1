"""Checkpoints that are whole or absent: written beside their place, synced, then renamed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from dopepp.models.checkpoint import write_atomic


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, saved atomically and loaded without running code."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        """Write the file so that a crash leaves either the old or the new one."""
        target = Path(os.fspath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(checkpoint, target)

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Load a file as plain data; a pickled object in it is refused, whoever asks."""
        loaded: Mapping[str, Any] = super().load_checkpoint(
            path, map_location=map_location, weights_only=True
        )
        return dict(loaded)
