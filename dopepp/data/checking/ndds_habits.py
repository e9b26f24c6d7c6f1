"""What may differ between NDDS data sets but not within one, counted object by object."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

from dopepp.data.checking.report import CheckReport

DOCUMENTED: Final = {
    "quaternion_xyzw": "x, y, z, w",
    "bounding_box": "row, column",
    "camera axes": "OpenCV",
}
"""NDDS's own habits."""

_MAX_MINORITY: Final = 1000
"""Objects of each habit that are remembered, in case they turn out to be the minority."""


class Habits:
    """Collects habits; a data set's common one is noted, another one is a defect."""

    def __init__(self, report: CheckReport) -> None:
        self._report = report
        self._votes: dict[str, Counter[str]] = {}
        self._places: dict[tuple[str, str], list[tuple[Path, str]]] = {}

    def vote(self, habit: str, value: str, path: Path, where: str) -> None:
        """Count one object's habit."""
        self._votes.setdefault(habit, Counter())[value] += 1
        places = self._places.setdefault((habit, value), [])
        if len(places) < _MAX_MINORITY:
            places.append((path, where))

    def conclude(self) -> None:
        """Note each habit that is not NDDS's own, and report the objects that have another."""
        for habit, votes in self._votes.items():
            (common, number), *rest = votes.most_common()
            if common != DOCUMENTED[habit]:
                self._report.note(f"{habit}: {common} ({number:,} objects)")
            for value, _ in rest:
                for path, where in self._places[habit, value]:
                    self._report.add(path, where, f"{value}; {number:,} objects have {common}")
