"""What came of the grasps: Table 9, failures, a curve; as JSON, CSV and Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.files import write_csv, write_picture, write_whole
from dopepp.robot.grasping.task import BLOCK, EXACT, FAILURES, Record

PAPER: Final = ((49, 47), (46, 46), (47, 43), (46, 45))
"""Table 9: recognised and caught of every 50 grasps, with a real arm."""


@dataclass(frozen=True)
class Counts:
    """Of some trials."""

    trials: int
    recognised: int
    caught: int

    def rate(self, count: int) -> str:
        """Return a count as a share with its Wilson interval."""
        from dopepp.metrics.functional.rates import wilson_interval

        low, high = wilson_interval(count, self.trials)
        return f"{100 * count / self.trials:.1f} % ({100 * low:.1f} – {100 * high:.1f})"


def counted(records: Sequence[Record]) -> Counts:
    """Count trials."""
    return Counts(
        len(records), sum(one.recognised for one in records), sum(one.caught for one in records)
    )


def by_source(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Sort records by the source of poses, each by trial."""
    found: dict[str, list[Record]] = {}
    for one in sorted(records, key=lambda record: record.number):
        found.setdefault(one.source, []).append(one)
    return found


def table_9(records: Sequence[Record]) -> list[str]:
    """Return the paper's table with one source's trials beside it, in Markdown."""
    lines = [
        "| grasps | recognised | caught | paper: recognised | caught |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for first in range(0, len(records), BLOCK):
        block, number = records[first : first + BLOCK], first // BLOCK
        here = counted(block)
        paper = PAPER[number] if number < len(PAPER) and len(block) == BLOCK else None
        there = (
            "| – | – |"
            if paper is None
            else f"| {paper[0]} ({2 * paper[0]} %) | {paper[1]} ({2 * paper[1]} %) |"
        )
        lines.append(
            f"| {first + 1}–{first + len(block)} "
            f"| {here.recognised} ({100 * here.recognised / here.trials:.0f} %) "
            f"| {here.caught} ({100 * here.caught / here.trials:.0f} %) {there}"
        )
    whole = counted(records)
    recognised, caught = (sum(one) for one in zip(*PAPER, strict=True))
    paper_text = f"{Counts(200, 0, 0).rate(recognised)} | {Counts(200, 0, 0).rate(caught)}"
    lines.append(
        f"| all, with 95 % intervals | {whole.rate(whole.recognised)} "
        f"| {whole.rate(whole.caught)} | {paper_text} |"
    )
    return lines


def sources_table(records: Sequence[Record]) -> list[str]:
    """Return a row for every source of poses, in Markdown."""
    lines = [
        "| poses | trials | recognised (ADD-0.1d) | caught | median error at the arm "
        f"| {' | '.join(FAILURES)} |",
        f"| --- | ---: | ---: | ---: | ---: {'| ---: ' * len(FAILURES)}|",
    ]
    for name, rows in by_source(records).items():
        here, failures = counted(rows), [one.failure for one in rows]
        off = [
            float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")
            for values in ([one.error_mm for one in rows], [one.error_deg for one in rows])
        ]
        lines.append(
            f"| {name} | {here.trials} | {here.rate(here.recognised)} | {here.rate(here.caught)} "
            f"| {off[0]:.2f} mm, {off[1]:.2f}° "
            f"| {' | '.join(str(failures.count(one)) for one in FAILURES)} |"
        )
    return lines


def markdown(records: Sequence[Record], facts: Mapping[str, Any]) -> str:
    """Return the whole report."""
    sources = by_source(records)
    first = next(iter(sources.values()))
    lines = [
        "# Grasps in simulation", "",
        *(f"- {name}: {value}" for name, value in facts.items() if value is not None), "",
        f"## Table 9: {first[0].source}", "", *table_9(first), "",
        "## Poses and failures", "", *sources_table(records), "",
    ]  # fmt: skip
    return "\n".join(lines)


def write_report(folder: Path, records: Sequence[Record], facts: Mapping[str, Any]) -> None:
    """Write ``grasps.csv``, ``grasps.json``, ``grasps.md`` and, of a curve, ``curve.png``."""
    ordered = [one for rows in by_source(records).values() for one in rows]
    write_csv(folder / "grasps.csv", [asdict(one) for one in ordered])
    content = {
        **facts,
        "sources": {name: _summary(rows) for name, rows in by_source(records).items()},
        "trials": [_plain(one) for one in ordered],
    }
    write_whole(folder / "grasps.json", (json.dumps(content, indent=1) + "\n").encode())
    write_whole(folder / "grasps.md", markdown(records, facts).encode())
    if any(one.off for one in records):
        from dopepp.drawing.curves import figure_image

        write_picture(folder / "curve.png", figure_image(curve(records)))


def curve(records: Sequence[Record]) -> Any:
    """Draw how often parts are caught by poses that are off."""
    from dopepp.drawing.curves import RateCurve, rates_figure
    from dopepp.metrics.functional.rates import wilson_interval

    points = []
    for name, rows in by_source(records).items():
        if name.startswith(EXACT):
            here = counted(rows)
            ends = wilson_interval(here.caught, here.trials)
            points.append((rows[0].off, here.caught / here.trials, *ends))
    x, rate, low, high = (np.array(one) for one in zip(*sorted(points), strict=True))
    return rates_figure(
        {"caught": {"exact poses, off": RateCurve(x, rate, low, high)}},
        "error of the pose, mm and, at once, degrees", 1,
    )  # fmt: skip


def _summary(rows: Sequence[Record]) -> dict[str, Any]:
    from dopepp.metrics.functional.rates import wilson_interval

    here = counted(rows)
    return {
        **asdict(here),
        "recognised_interval": wilson_interval(here.recognised, here.trials),
        "caught_interval": wilson_interval(here.caught, here.trials),
        "failures": {name: sum(one.failure == name for one in rows) for name in FAILURES},
    }


def _plain(record: Record) -> dict[str, Any]:
    """Return a record for JSON, which knows no NaN."""
    values = {one.name: getattr(record, one.name) for one in fields(record)}
    return {name: None if value != value else value for name, value in values.items()}
