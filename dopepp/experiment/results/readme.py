"""``README.md`` of a run folder: what was run, what came out, what each file is, how to go on.

It is written when a run begins and again when it ends, however it ends. To explain a further file,
one line in :data:`FILES`.
"""

from __future__ import annotations

import os
import shlex
import socket
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from dopepp.core.files import write_whole
from dopepp.experiment import program
from dopepp.experiment.config.run import RunConfig
from dopepp.experiment.program import shown
from dopepp.experiment.results.folder import BEST_CHECKPOINT, VERSIONS_FILE, read_json
from dopepp.experiment.results.report import Report
from dopepp.experiment.results.tables import markdown_text
from dopepp.metrics.row import shown_columns
from dopepp.training.callbacks.validation import best_effort

README_FILE: Final = "README.md"

RUNNING: Final = "running"
FINISHED: Final = "finished"
INTERRUPTED: Final = "interrupted"
FAILED: Final = "failed"
PRUNED: Final = "stopped by the search"

FILES: Final = {
    "checkpoints/best_tuned.ckpt": "the same as `best.ckpt`, tuned; the one to use",
    "checkpoints/best.ckpt": "the weights with the best validation",
    "checkpoints/last.ckpt": "where `resume=` goes on",
    "checkpoints/previous.ckpt": "the one before, should that be damaged",
    "metrics.json": "the measurement on the test set, every instance's error included",
    "metrics.csv": "losses, rates and validation over the steps",
    "config.yaml": "every option, resolved",
    "versions.json": "command, commit, packages, hardware, seed and fingerprint of the data",
    "overlay.png": "test images: truth in green, prediction in yellow",
    "auc.png": "share of test instances below each error (numbers in `auc.csv`)",
    "val_overlay.png": "validation images of the last epoch",
    "val_belief.png": "their belief maps: strongest corner and centroid",
    "val_auc.png": "their errors (numbers in `val_auc.csv`)",
    "shading.png": "pass rate with parts of the object covered (`shading.csv`)",
    "scale.png": "pass rate with the camera nearer or farther (`scale.csv`)",
    "scale_examples.png": "the same scenes at every scale, drawn as in `overlay.png`",
    "compare.md": "the methods side by side (numbers in `compare.csv`)",
    "table.md": "the same in the paper's layout, its figures beside them (`table.csv`)",
    "lr_finder.png": "loss against learning rate (numbers in `lr_finder.csv`)",
    "cost.json": "parameters, operations, and times from picture to poses and of the network alone",
    "frame_rate.png": "frames a second over time, dashed the network alone (`frames.csv`)",
    "tuning.json": "what tuning has changed",
    "job.log": "what the job has printed",
    "wandb": "what Weights & Biases holds of it; `wandb sync` sends it",
    "tensorboard": "what TensorBoard shows of it",
    "profile": "where the time went",
    "nonfinite": "the batch whose loss or gradient was not finite",
    "failed.json": "why the job failed",
    "pruned.json": "why the search stopped it",
}
"""What a run may leave, in the order of a reader's interest."""

_PICTURES: Final = (
    "overlay.png", "auc.png", "val_overlay.png", "val_belief.png", "lr_finder.png",
    "frame_rate.png", "shading.png", "scale.png", "scale_examples.png",
)  # fmt: skip


class RunReadme:
    """The README of one training; nothing is written before :meth:`begin`.

    A run that could not begin leaves what stands in its folder as it is. One whose README cannot
    be written goes on without.
    """

    def __init__(self, config: RunConfig, run_dir: Path) -> None:
        self._config, self._folder = config, run_dir
        self._begun = False

    def begin(self) -> None:
        """Say that the run is at work, and which process does it."""
        self._begun = True
        since = datetime.now().astimezone().isoformat(" ", "seconds")
        self._write(
            RUNNING,
            f"Since {since}, process {os.getpid()} on {socket.gethostname()}. If that process is "
            "gone, it was killed: resume the run.",
        )

    def end(self, state: str, reason: str = "", report: Report | None = None) -> None:
        """Say how the run ended: one of this module's words, why in a line, what was measured."""
        if self._begun:
            self._write(state, reason, report)

    def _write(self, state: str, reason: str, report: Report | None = None) -> None:
        name = f"{self._config.model.name} on {self._config.data.name}"
        sections = [f"# {name}: {state}", reason, _commands(self._folder)]
        if report is not None:
            sections.append(_result(report))
        sections += [_pictures(self._folder), self._what_next(state, report), _files(self._folder)]
        _write(self._folder, sections)

    def _what_next(self, state: str, report: Report | None) -> str:
        run = shlex.quote(shown(self._folder))
        details = {} if report is None else report.details
        best = shlex.quote(shown(self._folder / details.get("checkpoint", BEST_CHECKPOINT)))
        if not self._config.keep_checkpoints:
            trial = "A trial of the program itself (`keep_checkpoints=false`)"
            return f"{trial}: nothing to go on with."
        train, evaluate = program.typed("train"), program.typed("evaluate")
        lines = [] if state == FINISHED else [f"{train} resume={run}  # go on"]
        if state == FINISHED:
            epochs = 2 * self._config.trainer.max_epochs
            lines += [
                f"{evaluate} ckpt_path={best} shading=[0.2,0.4,0.6,0.8] by=[distance]",
                f"{train} resume={run} trainer.max_epochs={epochs}  # train for longer",
            ]
        lines += [
            f"dopepp predict {best} PICTURE.png --K FX FY CX CY",
            f"dopepp compare {run} OTHER_RUN",
        ]
        return "## How to go on\n\n```bash\n" + "\n".join(lines) + "\n```"


def write_job_readme(folder: Path, title: str, report: Report | None = None) -> None:
    """Write the README of what is no training, when it is done; ``title`` says what it was."""
    result = "" if report is None else _result(report)
    _write(folder, [f"# {title}", _commands(folder), result, _pictures(folder), _files(folder)])


def write_sweep_readme(folder: Path, command: Sequence[str], jobs: Mapping[str, str]) -> None:
    """Write the README of a multirun's folder.

    ``jobs`` tells how each job stands, by its folder's name; it is empty while none has ended.
    """
    rows = [{"job": f"[{job}]({job}/)", "state": state} for job, state in jobs.items()]
    state = "finished" if jobs else "running; this page is written again at its end"
    links = {
        "compare.md": "The comparison is in [compare.md](compare.md), its numbers in "
        "`compare.csv`.",
        "compare.png": "![compare](compare.png)",
    }
    sections = [
        f"# Multirun: {state}",
        f"```bash\n{program.line(command)}\n```",
        *(text for name, text in links.items() if (folder / name).is_file()),
        "Every job that has begun to train has a README in its folder.",
        markdown_text(rows, ["job", "state"]) if rows else "",
    ]
    _write(folder, sections)


def _write(folder: Path, sections: Sequence[str]) -> None:
    path = folder / README_FILE
    with best_effort(str(path)):
        write_whole(path, ("\n\n".join(filter(None, sections)) + "\n").encode())


def _commands(folder: Path) -> str:
    """Return the command, and those that went on with the run."""
    present = read_json(folder / VERSIONS_FILE)
    earlier = present.get("earlier", [])
    calls = [
        one["command"]
        for one in (*(earlier if isinstance(earlier, list) else []), present)
        if isinstance(one, Mapping) and isinstance(one.get("command"), list)
    ]
    lines = [program.line([str(word) for word in call]) for call in calls if call]
    return "```bash\n" + "\n".join(lines) + "\n```"


def _result(report: Report) -> str:
    """Return the tables that the terminal showed, one per object."""
    sections = [f"## Result on {report.num_images} test images"]
    for name, rows in report.tables.items():
        if rows[0].num_instances == 0:
            sections.append(f"{name}: not in the test images.")
            continue
        columns = shown_columns(rows[0])
        table = [
            {name: one.heading, **{row.method: one.text(row) for row in rows}} for one in columns
        ]
        sections.append(markdown_text(table, [name]).rstrip())
    sections.append(
        "The first column of figures is the network's; the others say what chance and a constant "
        "pose reach on the same images."
    )
    return "\n\n".join(sections)


def _pictures(folder: Path) -> str:
    lines = [
        f"![{FILES[name]}]({name})\n\n*{name}: {FILES[name]}*"
        for name in _PICTURES
        if (folder / name).is_file()
    ]
    return "\n\n".join(["## Pictures", *lines]) if lines else ""


def _files(folder: Path) -> str:
    lines = [f"- `{name}`: {what}" for name, what in FILES.items() if (folder / name).exists()]
    return "\n".join(["## Files", "", *lines]) if lines else ""
