"""What every writer of a data set offers, so that a render job can be stopped at any moment.

Items are written one by one and finalized chunk by chunk. An item's last file is its marker, so
what is there is complete; files that a chunk's items share (``scene_gt.json``, a tar shard) are
assembled when all of them are there. To add a format, write such a class and one line in
``WRITERS`` of :mod:`dopepp.data.jobs.job`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dopepp.data.sample import Sample


class Writer(Protocol):
    """Writes samples into a folder; made anew in every process from (folder, parts).

    Everything goes through :func:`dopepp.core.files.write_whole` or the like: a file is there
    completely or not at all. The bytes of an item depend on nothing but (index, sample).
    """

    name: str
    """Name of the layout: ``bop``, ``ndds`` or ``webdataset``."""

    chunk_size: int
    """Items ``chunk·chunk_size … (chunk + 1)·chunk_size − 1`` are finalized together."""

    def prepare(self) -> None:
        """Write what the whole data set shares (models, settings); idempotent.

        Raises:
            UserError: The folder holds something else.
        """

    def write(self, index: int, sample: Sample) -> None:
        """Write one item completely; on return it survives a crash."""

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the chunk's complete items, finalized or not."""

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Assemble what the chunk's items share from the items themselves.

        Idempotent and atomic; two processes may do it at once, and a finalized chunk may be
        finalized again when later items have been added to it.
        """
