"""The experiment: trials shared out among processes, each a pure function of its seed.

What came of them is reported as JSON, CSV and Markdown: Table 9, failures, a curve.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import check_target, write_csv, write_picture, write_whole
from dopepp.core.pool import LostWorkerError, ProcessPool, available_cores
from dopepp.core.validation import Range, check
from dopepp.parts.catalogue import load_part
from dopepp.robot.grasping.cell import Cell, convex_pieces
from dopepp.robot.grasping.film import show
from dopepp.robot.grasping.grasps import find_grasps
from dopepp.robot.grasping.layouts import LAYOUTS
from dopepp.robot.grasping.rehearsal import SIZE
from dopepp.robot.grasping.task import BLOCK, EXACT, FAILURES, Record, Source, Task
from dopepp.robot.grasping.trial import Trials
from dopepp.robot.grasping.view import RENDERERS, open_gl

MAX_TRIALS: Final = 100_000

CURVE: Final = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Errors of poses at which grasps are tried, millimetres and, at once, degrees."""

PAPER: Final = ((49, 47), (46, 46), (47, 43), (46, 45))
"""Table 9: recognised and caught of every 50 grasps, with a real arm."""

SOURCES: Final[dict[str, tuple[Source, ...]]] = {
    "network": (Source(),),
    "exact": (Source("exact"),),
    "random": (Source("random"),),
    "true-matrices": (Source(matrices="true"),),
    "curve": tuple(Source("exact", error=(one, one)) for one in CURVE),
}
"""Where poses may come from, by the name on the command line."""


def parse_sources(text: str) -> tuple[Source, ...]:
    """Return the sources of a list with commas; a :class:`UserError` where one is unknown."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        _choose("--poses", name, SOURCES)
    return tuple(source for name in dict.fromkeys(names) for source in SOURCES[name])


def _choose(option: str, value: str, allowed: Iterable[str]) -> None:
    if value not in allowed:
        raise UserError(f"{option} {value}", ", ".join(allowed), f"change {option}")


def check_task(task: Task, poses: str, count: int) -> Task:
    """Return a task with its sources of poses, checked before anything slow is done.

    Raises:
        UserError: An option has a value that is not allowed, or the part no network or no grasp.
    """
    _choose("--layout", task.layout, LAYOUTS)
    _choose("--renderer", task.renderer, RENDERERS)
    _choose("--rest", task.rest, ("front", "any"))
    check("-n", count, int, Range(1, MAX_TRIALS))
    check("--yaw", task.yaw_deg, float, Range(0, 180, "degrees"))
    sources = parse_sources(poses)
    needs_network = any(source.kind == "network" for source in sources)
    if needs_network and task.network is None:
        raise UserError(
            f"part {task.part} without a network", "a checkpoint of it, or exact or random poses",
            "pass --network CHECKPOINT, or --poses exact",
        )  # fmt: skip
    part = load_part(task.part, task.unit)
    find_grasps(part, task.grasps)
    convex_pieces(part)  # which takes a minute, once, and not in every process
    return replace(task, sources=sources, network=task.network if needs_network else None)


def make_experiment(
    task: Task, count: int, workers: int | None, folder: Path,
    video: Path | None, rerun: Path | None, say: Callable[[str], object],
) -> str:  # fmt: skip
    """Make trials, write their report and pictures to a folder; return the tables, in Markdown."""
    films = ((folder / "grasps.md", (".md",)), (video, (".mp4", ".jpg")), (rerun, (".rrd",)))
    for path, suffixes in films:
        if path is not None:
            check_target(path, suffixes)
    if video is not None or task.renderer == "mujoco":
        open_gl(Cell(shown="things").model, SIZE).close()  # refused now, not after all trials
    start, records = time.monotonic(), []
    for record in run_trials(task, count, workers or available_cores()):
        records.append(record)
        done = len(records) // len(task.sources)
        if len(records) % (len(task.sources) * BLOCK) == 0:
            caught = sum(one.caught for one in records if one.source == task.sources[0].name)
            say(f"{done} of {count}: {caught} caught")
    facts = _facts(task, records, time.monotonic() - start)
    write_report(folder, records, facts)
    if all(one.failure == "no plan" for one in records):
        raise UserError(
            f"{task.grasps or task.part}: none of its grasps is reached in {count} trials",
            "grasps that come from above on a face on which the part lies",
            "write some with `dopepp grasp propose`, or see --rest",
        )
    show(task, records, folder, video, rerun)
    return markdown(records, facts)


def _facts(task: Task, records: Sequence[Record], seconds: float) -> dict[str, object]:
    """Return what a report says of a run."""
    distinct = {(one.hand_eye_mm, one.hand_eye_deg) for one in records}
    off = np.array(sorted(distinct))
    return {
        "part": task.part,
        "network": task.network and f"{task.network}, {'' if task.refine else 'not '}refined",
        "layout": task.layout,
        "pictures": task.renderer,
        "seed": task.seed,
        "hand-eye, worst": f"{off[:, 0].max():.2f} mm, {off[:, 1].max():.3f}°",
        "MuJoCo": version("mujoco"),
        "seconds": round(seconds),
    }


def run_trials(task: Task, count: int, workers: int) -> Iterator[Record]:
    """Make trials and yield their records as they come.

    Raises:
        RunError: A process has died.
        UserError: A trial refuses the task.
    """
    attempts = _Attempts(task)
    if workers == 1:
        for number in range(count):
            yield from attempts(number)
        return
    with ProcessPool(pickle.dumps(attempts), min(workers, count)) as pool:
        for _, future in pool.run(range(count)):
            try:
                yield from future.result()
            except LostWorkerError as error:
                raise RunError(str(error)) from error


class _Attempts:
    """Attempts a trial with every source of the task."""

    def __init__(self, task: Task) -> None:
        self._task = task

    @cached_property
    def _trials(self) -> Trials:
        return Trials(self._task)

    def __call__(self, number: int) -> list[Record]:
        scene = self._trials.scene(number)
        return [self._trials.attempt(scene, source).record for source in self._task.sources]


def _interval(count: int, trials: int) -> tuple[float, float]:
    from dopepp.metrics.functional import wilson_interval  # imports torch

    return wilson_interval(count, trials)


@dataclass(frozen=True)
class Counts:
    """Of some trials."""

    trials: int
    recognised: int
    caught: int

    def rate(self, count: int) -> str:
        """Return a count as a share with its Wilson interval."""
        low, high = _interval(count, self.trials)
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
        counts, paper = counted(block), "– | –"
        if number < len(PAPER) and len(block) == BLOCK:
            paper = " | ".join(f"{count} ({2 * count} %)" for count in PAPER[number])
        ours = " | ".join(
            f"{count} ({100 * count / counts.trials:.0f} %)"
            for count in (counts.recognised, counts.caught)
        )
        lines.append(f"| {first + 1}–{first + len(block)} | {ours} | {paper} |")
    ours, paper = (
        f"{counts.rate(counts.recognised)} | {counts.rate(counts.caught)}"
        for counts in (counted(records), Counts(200, *map(sum, zip(*PAPER, strict=True))))
    )
    return [*lines, f"| all, with 95 % intervals | {ours} | {paper} |"]


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

    points = []
    for name, rows in by_source(records).items():
        if name.startswith(EXACT):
            here = counted(rows)
            ends = _interval(here.caught, here.trials)
            points.append((rows[0].off, here.caught / here.trials, *ends))
    x, rate, low, high = (np.array(one) for one in zip(*sorted(points), strict=True))
    return rates_figure(
        {"caught": {"exact poses, off": RateCurve(x, rate, low, high)}},
        "error of the pose, mm and, at once, degrees", 1,
    )  # fmt: skip


def _summary(rows: Sequence[Record]) -> dict[str, Any]:
    counts = counted(rows)
    return {
        **asdict(counts),
        "recognised_interval": _interval(counts.recognised, counts.trials),
        "caught_interval": _interval(counts.caught, counts.trials),
        "failures": {name: sum(row.failure == name for row in rows) for name in FAILURES},
    }


def _plain(record: Record) -> dict[str, Any]:
    """Return a record for JSON, which knows no NaN."""
    return {name: None if value != value else value for name, value in asdict(record).items()}
