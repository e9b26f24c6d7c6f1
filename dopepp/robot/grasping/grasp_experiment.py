"""The grasp experiment: runs trials in several processes and reports them.

Each trial depends only on the seed and its number. The report consists of a JSON, a CSV and a
Markdown file with Table 9 and the failures, and a plot of the success rate.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import RunError, UserError, check_choice
from dopepp.core.files import check_target, write_csv, write_file, write_image
from dopepp.core.pool import LostWorkerError, ProcessPool, available_cores
from dopepp.core.validation import Range, check
from dopepp.parts.catalogue import load_part
from dopepp.parts.convex import convex_pieces
from dopepp.robot.grasping.cell import Cell
from dopepp.robot.grasping.film import show
from dopepp.robot.grasping.grasp_trial import (
    BLOCK,
    EXACT,
    FAILURES,
    GraspTask,
    PoseSource,
    Record,
    Trials,
)
from dopepp.robot.grasping.grasps import find_grasps
from dopepp.robot.grasping.rehearsal import SIZE
from dopepp.robot.grasping.workbench import LAYOUTS, RENDERERS, open_gl

MAX_TRIALS: Final = 100_000

CURVE: Final = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Errors that are added to exact poses, each in millimetres and in degrees."""

PAPER: Final = ((49, 47), (46, 46), (47, 43), (46, 45))
"""Table 9 of the paper: parts recognised and caught in 4 blocks of 50 grasps with a real arm."""

SOURCES: Final[dict[str, tuple[PoseSource, ...]]] = {
    "network": (PoseSource(),),
    "templates": (PoseSource("templates"),),
    "exact": (PoseSource("exact"),),
    "random": (PoseSource("random"),),
    "true-matrices": (PoseSource(matrices="true"),),
    "curve": tuple(PoseSource("exact", error=(error, error)) for error in CURVE),
}
"""Sources of the poses to grasp, by their name on the command line."""


def parse_sources(text: str) -> tuple[PoseSource, ...]:
    """Return the pose sources of a comma-separated list of names; repeated names count once.

    Raises:
        UserError: A name is not in :data:`SOURCES`.
    """
    names = dict.fromkeys(name.strip() for name in text.split(","))
    for name in names:
        check_choice("--poses", name, SOURCES)
    return tuple(source for name in names for source in SOURCES[name])


def check_task(task: GraspTask, poses: str, count: int) -> GraspTask:
    """Check the options of an experiment before its trials start, and set its pose sources.

    Args:
        task: Options from the command line.
        poses: Comma-separated names of :data:`SOURCES`.
        count: Number of trials.

    Returns:
        The task with its ``sources``; ``network`` is None if no source needs a network.

    Raises:
        UserError: An option has an invalid value, or the part has no checkpoint or no grasps.
    """
    check_choice("--layout", task.layout, LAYOUTS)
    check_choice("--renderer", task.renderer, RENDERERS)
    check_choice("--rest", task.rest, ("front", "any"))
    check("-n", count, int, Range(1, MAX_TRIALS))
    check("--views", task.views, int, Range(1, 2))
    check("--yaw", task.yaw_deg, float, Range(0, 180, "degrees"))
    sources = parse_sources(poses)
    needs_network = any(source.kind == "network" for source in sources)
    if needs_network and task.network is None:
        allowed = "a checkpoint of the part, or poses by templates, exact or random"
        fix = "pass --network CHECKPOINT, or --poses templates"
        raise UserError(f"part {task.part} without a network", allowed, fix)
    if task.views > 1 and not task.refine:
        allowed = "refined poses, which several views need"
        raise UserError("--views 2 with --no-refine", allowed, "leave out --no-refine")
    part = load_part(task.part, task.unit)
    find_grasps(part, task.grasps)
    convex_pieces(part)  # cached for all processes: a new mesh takes a minute
    return replace(task, sources=sources, network=task.network if needs_network else None)


def make_experiment(
    task: GraspTask,
    count: int,
    workers: int | None,
    folder: Path,
    video: Path | None,
    rerun: Path | None,
    report_progress: Callable[[str], object],
) -> str:
    """Run grasp trials; write their report, and images of failures, to a folder.

    Args:
        task: Options from :func:`check_task`.
        count: Number of trials with each source of poses.
        workers: Number of processes (default: one per core).
        folder: Target folder.
        video: Film of the first trial, .mp4 or .jpg.
        rerun: Rerun recording of the first trial.
        report_progress: Receives a line of text after every 50 trials.

    Returns:
        The report in Markdown.

    Raises:
        UserError: A file cannot be written, an image cannot be rendered, or no grasp is reachable.
    """
    targets = ((folder / "grasps.md", (".md",)), (video, (".mp4", ".jpg")), (rerun, (".rrd",)))
    for path, suffixes in targets:
        if path is not None:
            check_target(path, suffixes)
    if video is not None or task.renderer == "mujoco":
        open_gl(Cell(shown="solids").model, SIZE).close()  # fail now, not after all trials
    start, records = time.monotonic(), []
    for done, trial in enumerate(run_trials(task, count, workers or available_cores()), 1):
        records += trial
        if done % BLOCK == 0:
            first = [record for record in records if record.source == task.sources[0].name]
            report_progress(f"{done} of {count}: {count_records(first).caught} caught")
    facts = _facts(task, records, time.monotonic() - start)
    write_report(folder, records, facts)
    if all(record.failure == "no plan" for record in records):
        raise UserError(
            f"{task.grasps or task.part}, whose grasps were not reachable in any of {count} trials",
            "grasps from above that suit the face on which the part rests",
            "write other grasps with `dopepp grasp propose`, or pass another --rest",
        )
    show(task, records, folder, video, rerun)
    return markdown(records, facts)


def _facts(task: GraspTask, records: Sequence[Record], seconds: float) -> dict[str, object]:
    """Return the settings, largest hand-eye errors and duration for the head of the report."""
    worst_shift_mm = max(record.hand_eye_mm for record in records)
    worst_turn_deg = max(record.hand_eye_deg for record in records)
    return {
        "part": task.part,
        "network": task.network and f"{task.network}, {'' if task.refine else 'not '}refined",
        "layout": task.layout,
        "pictures": task.renderer,
        "second view, first trial": next(
            (record.second_view for record in records if record.second_view), None
        ),
        "seed": task.seed,
        "hand-eye, worst": f"{worst_shift_mm:.2f} mm, {worst_turn_deg:.3f}°",
        "MuJoCo": version("mujoco"),
        "seconds": round(seconds),
    }


def run_trials(task: GraspTask, count: int, workers: int) -> Iterator[list[Record]]:
    """Run trials in ``workers`` processes; yield the records of a trial when the trial is done.

    Raises:
        RunError: A process died.
        UserError: The options do not suit a trial, e.g. the arm does not reach the tray.
    """
    run = partial(_run_trial, task)
    if workers == 1:
        for number in range(count):
            yield run(number)
        return
    with ProcessPool(pickle.dumps(run), min(workers, count)) as pool:
        for _, future in pool.run(range(count)):
            try:
                yield future.result()
            except LostWorkerError as error:
                raise RunError(str(error)) from error


def _run_trial(task: GraspTask, number: int) -> list[Record]:
    """Return the records of trial ``number``: all attempts with each pose source of the task."""
    trials = _task_trials(task)
    scene = trials.scene(number)
    return [attempt.record for source in task.sources for attempt in trials.attempts(scene, source)]


@lru_cache(maxsize=1)
def _task_trials(task: GraspTask) -> Trials:
    """Return the trials of a task; the models are loaded once in each process."""
    return Trials(task)


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


def count_records(records: Sequence[Record]) -> Counts:
    """Count the records with a recognised part and with a caught part."""
    recognised = sum(record.recognised for record in records)
    return Counts(len(records), recognised, sum(record.caught for record in records))


def by_source(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Group records by pose source, and sort each group by trial and attempt."""
    groups: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda record: (record.number, record.attempt)):
        groups.setdefault(record.source, []).append(record)
    return groups


def table_9(records: Sequence[Record]) -> list[str]:
    """Return Markdown lines of the paper's Table 9 (a row per 50 trials) for one pose source."""
    lines = [
        "| grasps | recognised | caught | paper: recognised | caught |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for first in range(0, len(records), BLOCK):
        block, number = records[first : first + BLOCK], first // BLOCK
        counts, paper = count_records(block), "– | –"
        if number < len(PAPER) and len(block) == BLOCK:
            paper = " | ".join(f"{count} ({2 * count} %)" for count in PAPER[number])
        ours = " | ".join(
            f"{count} ({100 * count / counts.trials:.0f} %)"
            for count in (counts.recognised, counts.caught)
        )
        lines.append(f"| {first + 1}–{first + len(block)} | {ours} | {paper} |")
    totals = (count_records(records), Counts(200, *map(sum, zip(*PAPER, strict=True))))
    rates = [f"{total.rate(total.recognised)} | {total.rate(total.caught)}" for total in totals]
    return [*lines, f"| all, with 95 % intervals | {' | '.join(rates)} |"]


def sources_table(records: Sequence[Record]) -> list[str]:
    """Return Markdown lines of a table of success rates and failures, a row per pose source."""
    lines = [
        "| poses | attempts | recognised (ADD-0.1d) | caught | median error at the arm "
        f"| {' | '.join(FAILURES)} |",
        f"| --- | ---: | ---: | ---: | ---: {'| ---: ' * len(FAILURES)}|",
    ]
    for name, rows in by_source(records).items():
        total = count_records(rows)
        errors = np.array([(row.error_mm, row.error_deg) for row in rows if row.seen])
        shift, rotation = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
        failures = [str(sum(row.failure == failure for row in rows)) for failure in FAILURES]
        lines.append(
            f"| {name} | {total.trials} | {total.rate(total.recognised)} "
            f"| {total.rate(total.caught)} | {shift:.2f} mm, {rotation:.2f}° "
            f"| {' | '.join(failures)} |"
        )
    return lines


@dataclass(frozen=True)
class HeapCounts:
    """Numbers of heaps, parts and attempts with one pose source."""

    heaps: int
    emptied: int  # heaps of which every part was lifted
    parts: int  # parts in all heaps
    lifted: int  # lifted parts, including those that the gripper held with another part
    attempts: int


def count_heaps(records: Sequence[Record]) -> HeapCounts:
    """Count heaps and their parts from the records of all attempts with one pose source."""
    left: dict[int, int] = {}
    for record in by_source(records)[records[0].source]:
        left[record.number] = record.parts - record.lifted
    parts = sum(record.parts for record in records if record.attempt == 1)
    emptied = sum(count == 0 for count in left.values())
    return HeapCounts(len(left), emptied, parts, parts - sum(left.values()), len(records))


def heaps_table(records: Sequence[Record]) -> list[str]:
    """Return Markdown lines of a table of emptied heaps, a row per pose source."""
    lines = [
        "| poses | heaps | emptied | parts lifted | caught at the first attempt |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name, rows in by_source(records).items():
        heaps = count_heaps(rows)
        first = count_records([row for row in rows if row.attempt == 1])
        emptied = Counts(heaps.heaps, heaps.emptied, 0).rate(heaps.emptied)
        lines.append(
            f"| {name} | {heaps.heaps} | {emptied} | {heaps.lifted} of {heaps.parts} "
            f"| {first.rate(first.caught)} |"
        )
    return lines


def _has_heaps(records: Sequence[Record]) -> bool:
    return any(record.parts > 1 for record in records)


def markdown(records: Sequence[Record], facts: Mapping[str, Any]) -> str:
    """Return the report in Markdown; ``facts`` are listed at its top."""
    first = next(iter(by_source(records).values()))
    listed = [f"- {name}: {value}" for name, value in facts.items() if value is not None]
    if _has_heaps(records):
        tables = {"Heaps": heaps_table(records), "Attempts": sources_table(records)}
    else:
        tables = {
            f"Table 9: {first[0].source}": table_9(first),
            "Poses and failures": sources_table(records),
        }
    lines = ["# Grasps in simulation", "", *listed, ""]
    for title, table in tables.items():
        lines += [f"## {title}", "", *table, ""]
    return "\n".join(lines)


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
        from dopepp.drawing.curves import figure_image

        write_image(folder / "curve.png", figure_image(curve(records)))


def curve(records: Sequence[Record]) -> Any:
    """Plot the share of caught parts against the error added to exact poses; return the figure."""
    from dopepp.drawing.curves import RateCurve, rates_figure

    points = []
    for name, rows in by_source(records).items():
        if name.startswith(EXACT):
            total = count_records(rows)
            rate = total.caught / total.trials
            points.append((rows[0].off, rate, *total.interval(total.caught)))
    rates = RateCurve(*(np.array(values) for values in zip(*sorted(points), strict=True)))
    label = "error of the pose, in mm and in degrees"
    return rates_figure({"caught": {"exact poses with errors": rates}}, label, 1)


def _summary(rows: Sequence[Record]) -> dict[str, Any]:
    """Return the counts of trials, their intervals and the number of each kind of failure."""
    total = count_records(rows)
    return {
        **asdict(total),
        **({"heaps": asdict(count_heaps(rows))} if _has_heaps(rows) else {}),
        "recognised_interval": total.interval(total.recognised),
        "caught_interval": total.interval(total.caught),
        "failures": {name: sum(row.failure == name for row in rows) for name in FAILURES},
    }
