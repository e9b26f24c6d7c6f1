"""Releasing a checkpoint: one small safetensors file and a model card that says what it can do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.experiment.results.folder import read_json
from dopepp.experiment.results.report import Report
from dopepp.experiment.results.tables import markdown_text, shown_rows
from dopepp.metrics.row import COLUMNS
from dopepp.models.checkpoint import SUFFIX, Checkpoint, read, write_content

MAX_BYTES: Final = 8_000_000
"""Of a released file: it travels with the package."""

_CARD_FIELDS: Final = (
    "num_instances", "add_01d", "add_005d", "pass_5cm", "pass_10cm", "auc_10cm",
    "median_rotation_deg", "median_translation", "miss_rate",
)  # fmt: skip


def release(checkpoint: Path, results: Path, name: str, folder: Path) -> list[Path]:
    """Write ``NAME.safetensors`` and its card ``NAME.md``; return both.

    ``results`` is ``metrics.json`` of a run or an evaluation of the checkpoint. A
    :class:`UserError`: a file is not what it should be, or the release is too large.
    """
    if not name.isidentifier():
        raise UserError(f"name {name!r}", "letters, digits and _", "choose another name")
    trained = read(checkpoint)
    report = Report.from_record(read_json(results))
    size = 2 * sum(value.numel() for value in trained.state_dict.values())
    if size > MAX_BYTES:
        raise UserError(
            f"{checkpoint} with {size:,} bytes of weights in half precision",
            f"at most {MAX_BYTES:,}", "release a narrower network (model.width)",
        )  # fmt: skip
    target, card = folder / f"{name}{SUFFIX}", folder / f"{name}.md"
    write_content(trained.to_file(), target)
    write_whole(card, _card(name, trained, report).encode())
    return [target, card]


def _card(name: str, trained: Checkpoint, report: Report) -> str:
    reported = [report] if report.refined is None else [report, report.refined]
    rows = [
        {"object": row.object, "method": row.method}
        | {one.heading: one.text(row) for one in COLUMNS if one.field in _CARD_FIELDS}
        for rows in [*(one.rows for one in reported), *report.references.values()]
        for row in shown_rows(rows).values()
    ]
    refine = "" if report.refined is None else " refine=region"
    width, height = trained.input_size
    parameters = sum(value.numel() for value in trained.state_dict.values())
    sizes = [f"- {part.name}: {1000 * part.diameter:.0f} mm across" for part in trained.parts]
    parts = "\n".join(sizes)
    return f"""# pretrained/{name}

Finds, on an RGB image with its camera matrix, the 6D pose of

{parts}

`python evaluate.py ckpt_path=pretrained/{name}{refine}` measures it;
`PoseEstimator.load("pretrained/{name}")` uses it.

- Network: {trained.data.get("name", "")}, {parameters:,} parameters, {width}×{height} pixels,
  weights in half precision.
- Trained on renders alone: {_training(trained.data)}
- Not for: other parts, other faces of the part than those it was trained on, people, anything where
  a wrong pose does harm.
- Licence: Apache-2.0.

Measured on {report.num_images} rendered images that it was not trained on, with the reference rows
of the same images:

{markdown_text(rows)}"""


def _training(data: Mapping[str, Any]) -> str:
    config = data.get("config") or {}
    virtual = config.get("virtual") or {}
    masks = (config.get("masking") or {}).get("probability", 0)
    preset = f"preset `{virtual.get('preset')}`"
    return f"{preset}, random masks on {100 * masks:.0f} % of the instances."
