"""Recognise the layout of a data set's folder, and check its files and annotations for defects.

To add a layout, write ``check_NAME(report)`` in the module of its invariants in
:mod:`dopepp.data.formats`, and a line in ``LAYOUTS``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.data.formats import RECORD_FILE
from dopepp.data.formats.bop.bop_invariants import check_bop, scene_folders
from dopepp.data.formats.ndds import OBJECT_SETTINGS, find_items
from dopepp.data.formats.ndds.ndds_invariants import check_ndds
from dopepp.data.formats.problems import CheckReport
from dopepp.data.formats.webdataset.webdataset_invariants import check_webdataset, shard_paths
from dopepp.data.formats.ycb_video.ycb_invariants import check_ycb

_MAX_LISTED: Final = 8  # data sets that an error message lists

LAYOUTS: Final[dict[str, tuple[Callable[[Path], bool], Callable[[CheckReport], None]]]] = {
    "YCB-Video": (lambda root: all((root / n).is_dir() for n in ("image_sets", "data")), check_ycb),
    "BOP-WebDataset": (lambda root: any(shard_paths(root)), check_webdataset),
    "BOP": (lambda root: any(scene_folders(root)), check_bop),
    "NDDS": (
        lambda root: any(root.rglob(OBJECT_SETTINGS)) or bool(find_items(root)[0]),
        check_ndds,
    ),
}
"""Functions that recognise and check each layout, in order of recognition."""


def check_dataset(root: Path) -> CheckReport:
    """Return the defects of the data set in folder ``root``, in any layout of :data:`LAYOUTS`.

    Raises:
        UserError: The folder is missing, has an unknown layout, or holds several data sets.
    """
    root = Path(root)
    allowed = (
        "a YCB-Video folder (data/, image_sets/), a BOP data set, split or scene (scene_gt.json), "
        "BOP-WebDataset shards (*.tar), or an NDDS or FAT folder (000000.json next to 000000.png)"
    )
    if not root.is_dir():
        fix = "pass the folder of the data set"
        raise UserError(f"{root}, which is not a folder", allowed, fix)
    layout = _layout_of(root)
    if layout in (None, "NDDS"):  # NDDS includes annotations of all subfolders
        _reject_parent(root, layout)
    if layout is None:
        problem = f"{root}, a folder with an unknown layout"
        raise UserError(problem, allowed, "pass the folder of the data set")
    report = CheckReport(root, layout)
    LAYOUTS[layout][1](report)
    return report


def _layout_of(root: Path) -> str | None:
    return next((name for name, (is_layout, _) in LAYOUTS.items() if is_layout(root)), None)


def _reject_parent(root: Path, layout: str | None) -> None:
    """Raise a UserError if the subfolders of ``root``, of this layout, are separate data sets."""
    if (root / RECORD_FILE).is_file() or any(root.glob("*.json")):
        return
    folders = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")]
    layouts = {path: name for path in sorted(folders) if (name := _layout_of(path))}
    # FAT's scene folders form one data set, but each folder of a render job is its own data set.
    is_parent = any(
        name != "NDDS" or (path / RECORD_FILE).is_file() for path, name in layouts.items()
    )
    if not is_parent and (layout is not None or not layouts):
        return
    listed = [f"{path.name} ({name})" for path, name in layouts.items()]
    names = ", ".join(listed[:_MAX_LISTED])
    if len(listed) > _MAX_LISTED:
        names += f" and {len(listed) - _MAX_LISTED} more"
    problem = f"{root}, a folder of {len(listed)} data sets: {names}"
    fix = f"check each data set, e.g. dopepp check {next(iter(layouts))}"
    raise UserError(problem, "one data set", fix)
