"""The report of a grasp experiment: JSON, CSV, Markdown tables (Table 9) and a plot of rates."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.files import write_csv, write_file, write_image
from dopepp.robot.grasping.grasp_trial import BLOCK, EXACT, FAILURES, Record

PAPER: Final = ((49, 47), (46, 46), (47, 43), (46, 45))
"""Table 9 of the paper: parts recognised and caught in 4 blocks of 50 grasps with a real arm."""


@dataclass(frozen=True)
class Counts:
    """Numbers of trials, of recognised parts (ADD below a tenth of the diameter) and of catches."""

    trials: int  # with heaps, the number of attempts
    recognised: int
    caught: int

    def interval(self, count: int) -> tuple[float, float]:
        """Return the bounds of the 95 % Wilson interval of ``count / trials``, 0 to 1."""
        from dopepp.metrics.functional import wilson_interval  # imports torch

        return wilson_interval(count, self.trials)

    def rate(self, count: int) -> str:
        """Return ``count / trials`` and its 95 % interval as text, percent."""
        low, high = self.interval(count)
        return f"{100 * count / self.trials:.1f} % ({100 * low:.1f} – {100 * high:.1f})"


@dataclass(frozen=True)
class HeapCounts:
    """Numbers of heaps, parts and attempts with one pose source."""

    heaps: int
    emptied: int  # heaps of which every part was lifted
    parts: int  # parts in all heaps
    lifted: int  # lifted parts, including those that the gripper held with another part
    attempts: int


def count_records(records: Sequence[Record]) -> Counts:
    """Count the records with a recognised part and with a caught part."""
    recognised = sum(record.recognised for record in records)
    return Counts(len(records), recognised, sum(record.caught for record in records))


def count_heaps(records: Sequence[Record]) -> HeapCounts:
    """Count heaps and their parts from the records of all attempts with one pose source."""
    left: dict[int, int] = {}
    for record in by_source(records)[records[0].source]:
        left[record.number] = record.parts - record.lifted
    parts = sum(record.parts for record in records if record.attempt == 1)
    emptied = sum(count == 0 for count in left.values())
    return HeapCounts(len(left), emptied, parts, parts - sum(left.values()), len(records))


def by_source(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Group records by pose source, and sort each group by trial and attempt."""
    groups: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda record: (record.number, record.attempt)):
        groups.setdefault(record.source, []).append(record)
    return groups


def markdown(records: Sequence[Record], facts: Mapping[str, Any]) -> str:
    """Return the report in Markdown; ``facts`` are listed at its top."""
    first = next(iter(by_source(records).values()))
    listed = [f"- {name}: {value}" for name, value in facts.items() if value is not None]
    if _has_heaps(records):
        tables = {"Heaps": _heaps_table(records), "Attempts": _sources_table(records)}
    else:
        title = f"Table 9: {first[0].source}"
        tables = {title: _table_9(first), "Poses and failures": _sources_table(records)}
    lines = ["# Grasps in simulation", "", *listed, ""]
    for title, table in tables.items():
        lines += [f"## {title}", "", table, ""]
    return "\n".join(lines)


def _has_heaps(records: Sequence[Record]) -> bool:
    return any(record.parts > 1 for record in records)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, whose columns after the first are aligned to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _table_9(records: Sequence[Record]) -> str:
    """Return the paper's Table 9 (a row per 50 trials) for one pose source."""
    rows = []
    for first in range(0, len(records), BLOCK):
        block, number = records[first : first + BLOCK], first // BLOCK
        counts, paper = count_records(block), ["–", "–"]
        if number < len(PAPER) and len(block) == BLOCK:
            paper = [f"{count} ({2 * count} %)" for count in PAPER[number]]
        shares = [
            f"{count} ({100 * count / counts.trials:.0f} %)"
            for count in (counts.recognised, counts.caught)
        ]
        rows.append([f"{first + 1}–{first + len(block)}", *shares, *paper])
    totals = (count_records(records), Counts(200, *map(sum, zip(*PAPER, strict=True))))
    rates = [total.rate(count) for total in totals for count in (total.recognised, total.caught)]
    rows.append(["all, with 95 % intervals", *rates])
    return _table(["grasps", "recognised", "caught", "paper: recognised", "caught"], rows)


def _sources_table(records: Sequence[Record]) -> str:
    """Return a table of success rates and failures, a row per pose source."""
    rows = []
    for name, group in by_source(records).items():
        total = count_records(group)
        errors = np.array([(record.error_mm, record.error_deg) for record in group if record.seen])
        shift, rotation = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
        rates = [total.rate(total.recognised), total.rate(total.caught)]
        failures = [str(count) for count in _failures(group).values()]
        error = f"{shift:.2f} mm, {rotation:.2f}°"
        rows.append([name, str(total.trials), *rates, error, *failures])
    columns = ["poses", "attempts", "recognised (ADD-0.1d)", "caught", "median error at the arm"]
    return _table([*columns, *FAILURES], rows)


def _heaps_table(records: Sequence[Record]) -> str:
    """Return a table of emptied heaps, a row per pose source."""
    rows = []
    for name, group in by_source(records).items():
        heaps = count_heaps(group)
        first = count_records([record for record in group if record.attempt == 1])
        emptied = Counts(heaps.heaps, heaps.emptied, 0).rate(heaps.emptied)
        lifted = f"{heaps.lifted} of {heaps.parts}"
        rows.append([name, str(heaps.heaps), emptied, lifted, first.rate(first.caught)])
    return _table(
        ["poses", "heaps", "emptied", "parts lifted", "caught at the first attempt"], rows
    )


def _failures(records: Sequence[Record]) -> dict[str, int]:
    return {name: sum(record.failure == name for record in records) for name in FAILURES}


def write_report(folder: Path, records: Sequence[Record], facts: Mapping[str, Any]) -> None:
    """Write ``grasps.csv``, ``.json``, ``.md`` and, if poses have added errors, ``curve.png``."""
    groups = by_source(records)
    rows = [asdict(record) for group in groups.values() for record in group]
    write_csv(folder / "grasps.csv", rows)
    # JSON has no NaN.
    trials = [
        {name: None if value != value else value for name, value in row.items()} for row in rows
    ]
    summaries = {name: _summary(group) for name, group in groups.items()}
    content = {**facts, "sources": summaries, "trials": trials}
    write_file(folder / "grasps.json", (json.dumps(content, indent=1) + "\n").encode())
    write_file(folder / "grasps.md", markdown(records, facts).encode())
    if any(record.off for record in records):
        from dopepp.drawing.curves import RateCurve, figure_image, rates_figure

        points = []
        for name, group in groups.items():
            if name.startswith(EXACT):
                total = count_records(group)
                rate = total.caught / total.trials
                points.append((group[0].off, rate, *total.interval(total.caught)))
        curve = RateCurve(*(np.array(values) for values in zip(*sorted(points), strict=True)))
        label = "error of the pose, in mm and in degrees"
        figure = rates_figure({"caught": {"exact poses with errors": curve}}, label, 1)
        write_image(folder / "curve.png", figure_image(figure))


def _summary(records: Sequence[Record]) -> dict[str, Any]:
    """Return the counts of trials, their intervals and the number of each kind of failure."""
    total = count_records(records)
    return {
        **asdict(total),
        **({"heaps": asdict(count_heaps(records))} if _has_heaps(records) else {}),
        "recognised_interval": total.interval(total.recognised),
        "caught_interval": total.interval(total.caught),
        "failures": _failures(records),
    }
