"""The paper's tables: a sweep's runs in the paper's layout, beside what the paper printed.

A config names its table under ``table`` (see ``conf/experiment/``). How its rows come about stands
in :mod:`dopepp.experiment.reports.paper_rows`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.yaml import read_yaml
from dopepp.experiment import cost
from dopepp.experiment.reports.compare.entries import Entry
from dopepp.experiment.reports.compare.table import lines, noise
from dopepp.experiment.reports.paper_rows import KINDS, LABELS, Figures
from dopepp.experiment.reports.tables import ADD_5CM, ADD_10CM, csv_text, markdown_text
from dopepp.experiment.runs import display

TEXT_FILE: Final = "table.md"
TABLE_FILE: Final = "table.csv"

_PASS_FIELDS: Final = {rate.threshold: rate.field for rate in (ADD_5CM, ADD_10CM)}
_MEASURED: Final = ("poses", "shading")
"""Kinds that rest on trained networks."""
_UNTRAINED: Final = "dopepp.models.backbones.VGG19"


@dataclass(frozen=True)
class PaperTable:
    """How a sweep's table is laid out.

    Attributes:
        title: Its title, with the paper's number.
        kind: A key of :data:`~dopepp.experiment.reports.paper_rows.KINDS`.
        threshold: Of the paper's pass rate: 0.05 m for parts, 0.1 m for YCB-Video.
        labels: Override to what the paper calls it; a run that has several gets all of them.
        paper: What the paper prints: by label, object and measure, which is a field of ``PoseRow``
            (``pass`` for the paper's pass rate) or a heading; percent, or as the heading says.
        recomputed: Other methods, measured with this project's functions; likewise.
        notes: What must be said below the table.
    """

    title: str
    kind: str = "poses"
    threshold: float = 0.05
    labels: Mapping[str, str] = field(default_factory=dict)
    paper: Figures = field(default_factory=dict)
    recomputed: Figures = field(default_factory=dict)
    notes: Sequence[str] = ()

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> PaperTable:
        """Read the config's ``table``.

        Raises:
            UserError: A field or a value is unknown.
        """
        known = [entry.name for entry in fields(cls)]
        unknown = sorted(set(config) - set(known))
        if unknown:
            raise UserError(f"table.{unknown[0]}", ", ".join(known), "correct the table's field")
        if "title" not in config:
            raise UserError("a table without a title", "table.title", "name the table")
        table = cls(**config)
        if table.kind not in KINDS:
            raise UserError(f"table.kind={table.kind!r}", ", ".join(KINDS), "choose one of them")
        if table.threshold not in _PASS_FIELDS:
            allowed = ", ".join(f"{one:g}" for one in _PASS_FIELDS)
            raise UserError(f"table.threshold={table.threshold}", f"{allowed}, metres", "change it")
        return table

    @classmethod
    def read(cls, path: Path) -> PaperTable:
        """Read the ``table`` of an experiment's file, ``conf/experiment/NAME.yaml``.

        Raises:
            UserError: The file cannot be read, or its table is missing or wrong.
        """
        config = read_yaml(path)
        table = config.get("table") if isinstance(config, dict) else None
        if not isinstance(table, dict):
            raise UserError(
                f"{path}, which lays out no table", "an experiment with `table:`",
                "pass conf/experiment/table….yaml",
            )  # fmt: skip
        return cls.of(table)

    @property
    def pass_field(self) -> str:
        """Field of a row that holds the paper's pass rate."""
        return _PASS_FIELDS[self.threshold]

    def methods(self, entries: Sequence[Entry]) -> dict[str, Entry]:
        """Return the methods by what the paper calls them, or by their own name.

        The own name serves where the paper's would stand for several.
        """
        called = [self._label(entry) or entry.name for entry in entries]
        count = Counter(called)
        return {
            label if count[label] == 1 else entry.name: entry
            for label, entry in zip(called, entries, strict=True)
        }

    def _label(self, entry: Entry) -> str:
        overrides = entry.runs[0].overrides if entry.runs else ()
        return " ".join(label for key, label in self.labels.items() if key in overrides)


def write_paper_table(table: PaperTable, entries: Sequence[Entry], folder: Path) -> None:
    """Print and write ``table.md`` and ``table.csv``, and the figure of a kind that has one.

    Args:
        table: The layout.
        entries: The sweep's methods; one without a result is a row that says why.
        folder: Where the files go.
    """
    title = ", ".join([table.title, *(_recipe(entries) if table.kind in _MEASURED else [])])
    methods = table.methods(entries)
    rows = KINDS[table.kind](table, methods, folder)
    labels = sum(heading in LABELS for heading in rows[0])
    display.show_table(title, rows, num_labels=labels)
    write_whole(folder / TABLE_FILE, csv_text(rows).encode())
    found = [*_notes(table, entries), *(_doubts(methods) if table.kind == "poses" else [])]
    notes = [f"- {note}" for note in found]
    text = "\n".join([f"# {title}", "", markdown_text(rows), *notes])
    write_whole(folder / TEXT_FILE, f"{text}\n".encode())


def _recipe(entries: Sequence[Entry]) -> list[str]:
    """Say with which loss and schedule the networks were trained, ours or the paper's."""
    words = {str(run.config.get("recipe")) for entry in entries for run in entry.runs}
    known = sorted(words & {"ours", "paper"})
    return [f"recipe={' and '.join(known)}"] if known else []


def _notes(table: PaperTable, entries: Sequence[Entry]) -> list[str]:
    notes = [*table.notes, *([cost.NOTE] if table.kind == "time" else [])]
    if table.kind in _MEASURED:
        notes.append(f"The paper's pass rate is ADD < {table.threshold:g} m.")
        if any(_starts_untrained(run.config) for entry in entries for run in entry.runs):
            notes.append(
                "DOPE's VGG19 started untrained, as nothing is downloaded; "
                "model.backbone.weights_path=FILE starts it from a file of torchvision's."
            )
    if not table.paper:
        notes.append("The paper prints no such table.")
    return notes


def _doubts(methods: Mapping[str, Entry]) -> list[str]:
    """Name the differences that may be chance, and how many seeds would tell."""
    return noise(lines([replace(entry, name=label) for label, entry in methods.items()]))


def _starts_untrained(config: Mapping[str, Any]) -> bool:
    """Tell whether a run's network has a VGG19 that nobody has trained before."""
    model = config.get("model")
    backbone = model.get("backbone") if isinstance(model, dict) else None
    if not isinstance(backbone, dict) or config.get("init_from") is not None:
        return False
    return backbone.get("_target_") == _UNTRAINED and backbone.get("weights_path") is None
