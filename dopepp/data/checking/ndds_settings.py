"""Check NDDS's settings files, each once, and hand them on where they are usable."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any

from dopepp.data.checking.report import CheckReport
from dopepp.data.checking.values import entries, load_json
from dopepp.data.ndds_files import CAMERA_SETTINGS, OBJECT_SETTINGS, Settings


class CheckedSettings:
    """The settings files; what is wrong with them is reported once."""

    def __init__(self, report: CheckReport) -> None:
        self._report = report
        self._settings = Settings(report.root)
        self._seen: dict[Path, bool] = {}

    def of(self, path: Path) -> Settings | None:
        """Return the settings of an annotation's folder, None where they are damaged."""
        places = [
            place
            for folder in {path.parent, self._report.root}
            for place in (folder / OBJECT_SETTINGS, folder / CAMERA_SETTINGS)
        ]
        for place in places:
            if place.is_file() and place not in self._seen:
                self._seen[place] = self._check(place)
        return self._settings if all(self._seen.get(place, True) for place in places) else None

    def _check(self, path: Path) -> bool:
        """Check one file; tell whether it can be used."""
        before = self._report.num_defects
        content = load_json(self._report, path)
        if not isinstance(content, dict):
            if content is not None:
                self._report.add(path, "top level", "allowed: a JSON object")
            return False
        usable = self._report.num_defects == before
        if path.name == OBJECT_SETTINGS:
            self._check_objects(path, content)
        else:
            cameras = entries(self._report, path, "camera_settings", content.get("camera_settings"))
            names = [str(camera.get("name")) for camera in cameras]
            for name in twice(names):
                self._report.add(path, "camera_settings.name", f"{name!r:.60} twice")
        return usable

    def _check_objects(self, path: Path, content: Mapping[str, Any]) -> None:
        listed = content.get("exported_object_classes")
        objects = entries(
            self._report, path, "exported_objects", content.get("exported_objects", [])
        )
        names = {entry.get("class") for entry in objects}
        if isinstance(listed, list) and objects:
            for name in sorted(set(map(str, listed)) - {str(name) for name in names}):
                self._report.add(path, "exported_objects", f"no entry for class {name!r:.60}")


def twice(values: Iterable[Hashable]) -> list[Hashable]:
    """Return the values that come more than once."""
    return [value for value, number in Counter(values).items() if number > 1]
