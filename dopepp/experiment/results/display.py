"""Print configs, reports and tables to the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console, JustifyMethod
from rich.table import Table

from dopepp.data.sample import SourceInfo
from dopepp.experiment.results.frame import FIELDS, header_of
from dopepp.experiment.results.report import Report
from dopepp.metrics.row import shown_columns

# Tables are wider than the default of 80 columns for pipes; a terminal keeps its own width. Markup
# is off because overrides, paths and messages contain square brackets.
console = Console(highlight=False, markup=False, width=None if Console().is_terminal else 180)


def show_config(config: Mapping[str, Any]) -> None:
    """Print a nested config as YAML."""
    console.print("config", style="bold")
    console.print(yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))


def show_sources(sources: Sequence[tuple[str, SourceInfo]]) -> None:
    """Print the sources of each split with their numbers of images and instances."""
    table = Table("split", "source", "images", "per epoch", "instances", title="data")
    for split, info in sources:
        instances = ", ".join(f"{name} {count:,}" for name, count in info.num_instances.items())
        per_epoch = info.num_images if info.num_per_epoch is None else info.num_per_epoch
        counts = (f"{info.num_images:,}", f"{per_epoch:,}")
        table.add_row(split, info.name, *counts, instances or "in every render")
    console.print(table)


def show_report(report: Report, all_measures: bool = False) -> None:
    """Print a table per object: measures as rows; method, refined poses, references as columns.

    ``all_measures`` adds the symmetric measures of parts without symmetries.
    """
    for name, (row, *references) in report.tables.items():
        if row.num_instances == 0:
            absent = "n/a, no ground truth in the test set"
            false = FIELDS["false_per_frame"].text(row)
            console.print(f"{name}: {absent}; {false} false detections per frame")
            continue
        table = Table("", title=f"{name}: {report.num_images} test images")
        for method_row in (row, *references):
            table.add_column(
                method_row.method, justify="right", style="bold" if method_row is row else "dim"
            )
        for _, columns in groupby(shown_columns(row, all_measures), attrgetter("group")):
            for column in columns:
                table.add_row(column.heading, *map(column.text, (row, *references)))
            table.add_section()
        console.print(table)


def show_table(title: str, rows: Sequence[Mapping[str, str]], num_labels: int = 1) -> None:
    """Print rows as a table whose first ``num_labels`` columns are texts."""
    table = Table(title=title)
    header = header_of(rows)
    for number, heading in enumerate(header):
        justify: JustifyMethod = "left" if number < num_labels else "right"
        table.add_column(heading, justify=justify, overflow="fold")
    for row in rows:
        table.add_row(*(row.get(heading, "") for heading in header))
    console.print(table)


def show_files(run_dir: Path) -> None:
    """Print the files of a run folder and their sizes."""
    table = Table("file", "bytes")
    for path in sorted(run_dir.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(run_dir).parts)
        if path.is_file() and not hidden:
            table.add_row(str(path.relative_to(run_dir)), f"{path.stat().st_size:,}")
    console.print(f"run folder {run_dir}", soft_wrap=True)
    console.print(table)
