"""What a check found: defects, each with file and field, and notes that are no defects."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

_log = logging.getLogger(__name__)

MAX_KEPT: Final = 10_000
"""Defects kept in full; the rest is only counted, so that memory stays bounded."""

_LOG_EVERY: Final = 1000
"""Images between two lines of the log."""


@dataclass(frozen=True)
class Defect:
    """One thing that is wrong.

    Attributes:
        path: The file, below the data set's folder; a tar's member as ``TAR/MEMBER``.
        field: What in it, e.g. ``3[0].cam_R_m2c`` or ``size``.
        message: What was found and what is allowed.
    """

    path: str
    field: str
    message: str

    def __str__(self) -> str:
        """Return one line."""
        return " ".join(f"{self.path}: {self.field}: {self.message}".split())


@dataclass
class CheckReport:
    """The result of a check.

    Attributes:
        root: The folder.
        layout: Which layout was found, e.g. ``BOP``.
        num_images: Images that were looked at.
        defects: The first ``MAX_KEPT`` of them, in the order in which they were found.
        num_defects: All of them.
        counts: Defects by kind, which is the field's last part.
        notes: What is worth knowing and no defect.
    """

    root: Path
    layout: str
    num_images: int = 0
    defects: list[Defect] = field(default_factory=list)
    num_defects: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return self.num_defects == 0

    def add(self, path: Path | str, where: str, message: str) -> None:
        """Add a defect."""
        where = where.lstrip(".") or "top level"
        self.num_defects += 1
        self.counts[where.rpartition(".")[2]] += 1
        if len(self.defects) < MAX_KEPT:
            self.defects.append(Defect(self._relative(path), where, message))

    def note(self, text: str) -> None:
        """Add what is worth knowing and no defect, once."""
        if text not in self.notes:
            self.notes.append(text)

    def count_image(self) -> None:
        """Count an image; the log tells how far it is."""
        self.num_images += 1
        if self.num_images % _LOG_EVERY == 0:
            _log.info("%s images checked, %s defects", self.num_images, self.num_defects)

    def _relative(self, path: Path | str) -> str:
        path = Path(path)
        return path.relative_to(self.root).as_posix() if self.root in path.parents else str(path)

    def lines(self, most: int = 100) -> list[str]:
        """Return the notes, at most ``most`` defects, and a summary, a line each."""
        shown = [str(defect) for defect in self.defects[:most]]
        if self.num_defects > len(shown):
            shown.append(f"… and {self.num_defects - len(shown):,} more")
        kinds = ", ".join(f"{kind} {number:,}" for kind, number in self.counts.most_common())
        summary = (
            f"{self.root}: {self.layout}, {self.num_images:,} images, "
            f"{self.num_defects:,} defects{f' ({kinds})' if kinds else ''}"
        )
        return [*(f"note: {note}" for note in self.notes), *shown, summary]
