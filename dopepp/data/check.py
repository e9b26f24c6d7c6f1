"""Recognise the layout of a data set's folder, and check its files and annotations for defects.

To add a layout, write ``check_NAME(report)`` in :mod:`dopepp.data.formats`, and a line below.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_invariants import check_bop, scene_folders
from dopepp.data.formats.ndds import OBJECT_SETTINGS, find_items
from dopepp.data.formats.ndds.ndds_invariants import check_ndds
from dopepp.data.formats.problems import CheckReport
from dopepp.data.formats.webdataset.webdataset_invariants import check_webdataset, shard_paths
from dopepp.data.formats.ycb_video.ycb_invariants import check_ycb

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
        UserError: The folder is missing, or has an unknown layout.
    """
    layout = next((name for name, (is_layout, _) in LAYOUTS.items() if is_layout(root)), None)
    if layout is None:
        problem = "which is not a folder" if not root.is_dir() else "a folder of an unknown layout"
        allowed = (
            "a YCB-Video folder (data/, image_sets/), a BOP data set, split or scene "
            "(scene_gt.json), BOP-WebDataset shards (*.tar), or an NDDS or FAT folder "
            "(000000.json next to 000000.png)"
        )
        raise UserError(f"{root}, {problem}", allowed, "pass the folder of the data set")
    report = CheckReport(root, layout)
    LAYOUTS[layout][1](report)
    if report.ok and report.num_images == 0:
        report.report(root, "images", "none found")
    return report
