"""The experiment: trials shared out among processes, each a pure function of its seed."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.checks import check_integer, check_number
from dopepp.core.errors import RunError, UserError
from dopepp.core.files import check_target
from dopepp.core.pool import LostWorkerError, ProcessPool, available_cores
from dopepp.parts.catalogue import load_part
from dopepp.robot.grasping.cell import Cell
from dopepp.robot.grasping.film import show
from dopepp.robot.grasping.grasps import find_grasps
from dopepp.robot.grasping.layouts import LAYOUTS
from dopepp.robot.grasping.rehearsal import SIZE
from dopepp.robot.grasping.report import markdown, write_report
from dopepp.robot.grasping.solid import convex_pieces
from dopepp.robot.grasping.task import BLOCK, Record, Source, Task
from dopepp.robot.grasping.trial import Trials
from dopepp.robot.grasping.view import RENDERERS, open_gl

MAX_TRIALS: Final = 100_000

CURVE: Final = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Errors of poses at which grasps are tried, millimetres and, at once, degrees."""

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
    names = [one.strip() for one in text.split(",")]
    for one in names:
        if one not in SOURCES:
            raise UserError(f"--poses {one}", ", ".join(SOURCES), "separate several by commas")
    return tuple(source for name in dict.fromkeys(names) for source in SOURCES[name])


def check_task(task: Task, poses: str, count: int) -> Task:
    """Return a task with its sources of poses, checked before anything slow is done.

    A :class:`UserError`: an option is none there is, or the part has no network or no grasp.
    """
    for name, value, allowed in (
        ("--layout", task.layout, LAYOUTS),
        ("--renderer", task.renderer, RENDERERS),
        ("--rest", task.rest, ("front", "any")),
    ):
        if value not in allowed:
            raise UserError(f"{name} {value}", ", ".join(allowed), "pass one of these")
    check_integer("-n", count, 1, MAX_TRIALS)
    check_number("--yaw", task.yaw_deg, 0.0, 180.0, "degrees")
    sources = parse_sources(poses)
    needed = any(one.kind == "network" for one in sources)
    if needed and task.network is None:
        raise UserError(
            f"part {task.part} without a network", "a checkpoint of it, or exact or random poses",
            "pass --network CHECKPOINT, or --poses exact",
        )  # fmt: skip
    part = load_part(task.part, task.unit)
    find_grasps(part, task.grasps)
    convex_pieces(part)  # which takes a minute, once, and not in every process
    return replace(task, sources=sources, network=task.network if needed else None)


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
        for outcome in pool.run(range(count)):
            if isinstance(outcome.error, LostWorkerError):
                raise RunError(str(outcome.error)) from outcome.error
            yield from outcome.result()


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
