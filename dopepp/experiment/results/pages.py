"""Write Markdown pages: READMEs of runs and multiruns, comparisons and the cards of releases.

The texts are jinja2 templates in ``templates/``. The README of a run states the command, the
result, the meaning of each file (:data:`FILES`) and the next steps, at its start and end.
"""

from __future__ import annotations

import os
import shlex
import socket
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from dopepp.core.errors import UserError
from dopepp.core.files import write_file
from dopepp.experiment import program
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results.breakdown import QUANTITIES
from dopepp.experiment.results.false_alarms import alarm_rows
from dopepp.experiment.results.folder import BEST_CHECKPOINT, VERSIONS_FILE, read_json
from dopepp.experiment.results.frame import markdown, shown_rows
from dopepp.experiment.results.report import Report
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, PoseRow, shown_columns
from dopepp.models.checkpoint import SUFFIX, read, write_content
from dopepp.training.pose_validation import best_effort

README_FILE: Final = "README.md"

RUNNING: Final = "running"
FINISHED: Final = "finished"
INTERRUPTED: Final = "interrupted"
FAILED: Final = "failed"
PRUNED: Final = "stopped by the search"

FILES: Final = {
    "checkpoints/best_tuned.ckpt": "`best.ckpt` after tuning; the checkpoint to use",
    "checkpoints/best.ckpt": "weights with the best validation result",
    "checkpoints/last.ckpt": "latest state, from which `resume=` continues",
    "checkpoints/previous.ckpt": "the state before `last.ckpt`, as a backup",
    "metrics.json": "result on the test set, with the error of every instance",
    "metrics.csv": "losses, rates and validation over the steps",
    "config.yaml": "all options, resolved",
    "versions.json": "command, commit, packages, hardware, seed and fingerprint of the data",
    "without_part.png": "highest-scoring images without the part, with the best candidates",
    "overlay.png": "test images: truth in green, prediction in yellow",
    "coverage.png": "share of true poses inside the covariance region, over the region's level",
    "auc.png": "share of test instances below each error (numbers in `auc.csv`)",
    "val_overlay.png": "validation images of the last epoch",
    "val_belief.png": "belief maps of these images: strongest corner and centroid",
    "val_auc.png": "errors on these images (numbers in `val_auc.csv`)",
    "refined.png": "share of correct refined poses on validation images, over the training time",
    "shading.png": "pass rate of partly covered objects (`shading.csv`)",
    "shading_examples.png": "the same images at every share, drawn as in `overlay.png`",
    "scale.png": "pass rate at other camera distances (`scale.csv`)",
    "scale_examples.png": "the same scenes at every scale, drawn as in `overlay.png`",
    **{f"by_{name}.png": f"rates per bin of {name} (`by_{name}.csv`)" for name in QUANTITIES},
    "compare.md": "the methods side by side (numbers in `compare.csv`)",
    "table.md": "the methods in the layout of the paper, with the paper's values (`table.csv`)",
    "lr_finder.png": "loss against learning rate (numbers in `lr_finder.csv`)",
    "cost.json": "parameters, operations, and times of whole frames and of the network alone",
    "frame_rate.png": "frames per second over time; dashed: the network alone (`frames.csv`)",
    "tuning.json": "changes by tuning",
    "job.log": "output of the job",
    "wandb": "log for Weights & Biases; upload with `wandb sync`",
    "tensorboard": "log for TensorBoard",
    "profile": "running time by function",
    "nonfinite": "the batch whose loss or gradient was not finite",
    "failed.json": "reason for the failure of the job",
    "pruned.json": "reason for stopping the trial",
}
"""Files that a run may write, ordered by relevance."""

# Images that a run's README shows.
_IMAGES: Final = [name for name in FILES if name.endswith(".png") and name != "val_auc.png"]

MAX_BYTES: Final = 8_000_000  # maximum size of a released file, which is part of the package

_CARD_FIELDS: Final = (
    "num_instances", "add_01d", "add_005d", "pass_5cm", "pass_10cm", "auc_10cm",
    "median_rotation_deg", "median_translation", "matching_radius", "miss_rate", "precision",
    "false_per_frame", "average_precision", "coverage",
)  # fmt: skip


@cache
def _templates() -> Environment:
    """Return the page templates of this package, in which an undefined name is an error."""
    folder = Path(__file__).parent / "templates"
    options: Any = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    return Environment(loader=FileSystemLoader(folder), undefined=StrictUndefined, **options)


def write_page(path: Path, template: str, **content: object) -> None:
    """Render ``templates/TEMPLATE.md.j2`` with the content and write the page."""
    text = _templates().get_template(f"{template}.md.j2").render(content)
    write_file(path, text.encode())


class RunReadme:
    """README of a training run, which continues if its README cannot be written.

    Nothing is written before :meth:`begin`, so a run that cannot begin leaves its folder unchanged.
    """

    def __init__(self, config: RunConfig, run_dir: Path) -> None:
        self._config, self._folder = config, run_dir
        self._begun = False

    def begin(self) -> None:
        """Write the README of a run in progress, with its start time, process and machine."""
        self._begun = True
        since = datetime.now().astimezone().isoformat(" ", "seconds")
        self.end(
            RUNNING,
            f"Since {since}, process {os.getpid()} on {socket.gethostname()}. If this process no "
            "longer exists, the run was killed: resume it.",
        )

    def end(self, state: str, reason: str = "", report: Report | None = None) -> None:
        """Write the README with a state, such as ``finished``, its reason and any result."""
        if not self._begun:
            return
        title = f"{self._config.model.name} on {self._config.data.name}: {state}"
        is_trial = not self._config.keep_checkpoints
        commands = [] if is_trial else self._next_commands(state, report)
        write_run_readme(self._folder, title, report, reason, commands, is_trial)

    def _next_commands(self, state: str, report: Report | None) -> list[str]:
        """Return suggested shell commands for a run in this state."""
        run = shlex.quote(program.relative_path(self._folder))
        checkpoint = {} if report is None else report.details
        best = self._folder / checkpoint.get("checkpoint", BEST_CHECKPOINT)
        best = shlex.quote(program.relative_path(best))
        train, evaluate = program.entry_command("train"), program.entry_command("evaluate")
        lines = [f"{train} resume={run}  # continue"]
        if state == FINISHED:
            epochs = 2 * self._config.trainer.max_epochs
            # Photographs may have no masks, which shading needs.
            is_rendered = self._config.data.is_rendered("test")
            shading = "'shading=[0.2,0.4,0.6,0.8]' " if is_rendered else ""
            lines = [
                f"{evaluate} ckpt_path={best} {shading}'by=[distance]'",
                f"{train} resume={run} trainer.max_epochs={epochs}  # train for longer",
            ]
        return [
            *lines,
            f"dopepp predict {best} IMAGE.png --K FX FY CX CY",
            f"dopepp compare {run} OTHER_RUN",
        ]


def write_run_readme(
    folder: Path,
    title: str,
    report: Report | None = None,
    reason: str = "",
    next_commands: Sequence[str] = (),
    is_trial: bool = False,
) -> None:
    """Write the README of a training run, an evaluation or another job.

    ``report`` is the result on the test set, if measured. A trial of a search keeps no checkpoints.
    """
    present = read_json(folder / VERSIONS_FILE)
    calls = [call.get("command") for call in (*present.get("earlier", []), present)]
    with best_effort(str(folder / README_FILE)):
        write_page(
            folder / README_FILE,
            "run",
            title=title,
            reason=reason,
            commands=[program.line(words) for words in calls if words],
            report=report,
            result_table=_result_table,
            alarms=markdown(rows) if report and (rows := alarm_rows(report)) else "",
            images={name: FILES[name] for name in _IMAGES if (folder / name).is_file()},
            next_commands=next_commands,
            is_trial=is_trial,
            files={name: text for name, text in FILES.items() if (folder / name).exists()},
        )


def _result_table(name: str, rows: Sequence[PoseRow]) -> str:
    """Return the Markdown table of an object: a line per measure, a column per method."""
    return markdown(
        [
            {name: measure.heading, **{row.method: measure.text(row) for row in rows}}
            for measure in shown_columns(rows[0])
        ]
    )


def write_multirun_readme(
    folder: Path, command: Sequence[str], jobs: Mapping[str, str], interrupted: bool = False
) -> None:
    """Write the README of a multirun with the state of each job, by folder; empty until the end."""
    rows = [{"job": f"[{job}]({job}/)", "state": state} for job, state in jobs.items()]
    with best_effort(str(folder / README_FILE)):
        write_page(
            folder / README_FILE,
            "multirun",
            command=program.line(command),
            has_table=(folder / "compare.md").is_file(),
            has_image=(folder / "compare.png").is_file(),
            jobs=markdown(rows) if rows else "",
            interrupted=interrupted,
            folder=folder,
        )


def release(checkpoint: Path, results: Path, name: str, folder: Path) -> list[Path]:
    """Write the weights ``NAME.safetensors`` and the model card ``NAME.md``; return both paths.

    ``results`` is the ``metrics.json`` of a run or an evaluation of the checkpoint.

    Raises:
        UserError: The name is invalid, the results are of other parts, or the network is too large.
    """
    if not name.isidentifier():
        allowed = "letters, digits and _, not starting with a digit"
        raise UserError(f"release name {name!r}", allowed, "choose a name such as my_part")
    trained = read(checkpoint)
    report = Report.from_record(read_json(results))
    names = [part.name for part in trained.parts]
    if others := ", ".join(part for part in report.rows if part not in (*names, MEAN)):
        allowed, fix = f"results of {', '.join(names)}", "pass the metrics.json of this run"
        raise UserError(f"{results} with results of {others}", allowed, fix)
    parameters = sum(value.numel() for value in trained.state_dict.values())
    if 2 * parameters > MAX_BYTES:
        raise UserError(
            f"{checkpoint} with {2 * parameters:,} bytes of weights in half precision",
            f"at most {MAX_BYTES:,}",
            "release a narrower network (model.width)",
        )
    target, card = folder / f"{name}{SUFFIX}", folder / f"{name}.md"
    write_content(trained.to_file(), target)
    reported = [report] if report.refined is None else [report, report.refined]
    config = trained.data.get("config") or {}
    columns = [column for column in COLUMNS if column.field in _CARD_FIELDS]
    rows = [
        {"object": row.object, "method": row.method}
        | {column.heading: column.text(row) for column in columns}
        for by_object in [*(report.rows for report in reported), *report.references.values()]
        for row in shown_rows(by_object).values()
    ]
    write_page(
        card,
        "card",
        name=name,
        trained=trained,
        parameters=parameters,
        preset=(config.get("virtual") or {}).get("preset"),
        masks=(config.get("masking") or {}).get("probability", 0),
        refine="" if report.refined is None else " refine=region",
        report=report,
        table=markdown(rows),
    )
    return [target, card]
