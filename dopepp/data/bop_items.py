"""Which of a data set's images a source takes: a share of them, or an evaluation's targets."""

from __future__ import annotations

from pathlib import Path

from dopepp.data.json_file import read_json
from dopepp.errors import UserError


def share(num_items: int, part_of: tuple[float, float], name: str) -> slice:
    """Return which of ``num_items`` items a share given in fractions is.

    Both bounds are rounded alike, so shares that meet in a fraction neither overlap nor leave out.

    Raises:
        ValueError: The fractions are not ascending in [0, 1].
        UserError: No item falls into the share.
    """
    first, last = part_of
    if not 0 <= first < last <= 1:
        raise ValueError(f"part_of must be ascending in [0, 1], got {part_of}")
    chosen = slice(round(first * num_items), round(last * num_items))
    if chosen.start == chosen.stop:
        raise UserError(
            f"{name}: no image in the share {first:.3g} – {last:.3g} of {num_items} images",
            "a folder with more images", "give every split a folder of its own",
        )  # fmt: skip
    return chosen


def read_targets(path: Path) -> set[tuple[int, int]]:
    """Return (scene, image) of every target of a file like ``test_targets_bop19.json``.

    Raises:
        UserError: The file is missing or damaged, or a target lacks a number.
    """
    records = read_json(path)
    if not isinstance(records, list) or not records:
        raise UserError(f"{path}", "a list of targets", "download the file again")
    images = set()
    for number, record in enumerate(records):
        fields = record if isinstance(record, dict) else {}
        pair = fields.get("scene_id"), fields.get("im_id")
        if type(pair[0]) is not int or type(pair[1]) is not int:
            raise UserError(
                f"{path}: target {number} with scene_id and im_id {pair}", "two whole numbers",
                "download the file again",
            )  # fmt: skip
        images.add((pair[0], pair[1]))
    return images
