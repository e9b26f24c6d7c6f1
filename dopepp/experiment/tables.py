"""Tables of rows by heading as CSV and Markdown; a row may lack columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

Row = dict[str, str]
"""Heading to text."""

_TEXTS: Final = ("method", "object", "measure", "overrides", "folder")
"""Headings of what is no number."""


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a CSV under the headings of the fullest row; what a row lacks, and None, is empty."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _header(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_csv(path: Path) -> list[Row]:
    """Read a CSV back; nothing where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def markdown_text(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a Markdown table under the headings of the fullest row, numbers to the right."""
    header = _header(rows)
    aligned = ["---" if heading in _TEXTS else "---:" for heading in header]
    cells = [header, aligned, *([row.get(key, "") for key in header] for row in rows)]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells
    )


def _header(rows: Sequence[Mapping[str, object]]) -> list[str]:
    fullest: Mapping[str, object] = max(rows, key=len)
    return list(fullest)
