"""The grasp experiment: runs trials in several processes and reports them.

Each trial depends only on the task, whose seed is an option, and on its number.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Final

from dopepp.core.errors import RunError, UserError, check_choice, require
from dopepp.core.files import check_target
from dopepp.core.pool import LostWorkerError, ProcessPool, available_cores
from dopepp.core.validation import Range, check
from dopepp.parts.catalogue import load_part
from dopepp.parts.convex import convex_pieces
from dopepp.robot.grasping.cell import Cell
from dopepp.robot.grasping.film import show
from dopepp.robot.grasping.grasp_report import count_records, markdown, write_report
from dopepp.robot.grasping.grasp_trial import BLOCK, GraspTask, PoseSource, Record, Trials
from dopepp.robot.grasping.grasps import find_grasps
from dopepp.robot.grasping.rehearsal import SIZE
from dopepp.robot.grasping.workbench import LAYOUTS, RENDERERS, open_gl

MAX_TRIALS: Final = 100_000

SOURCES: Final[dict[str, tuple[PoseSource, ...]]] = {
    "network": (PoseSource(),),
    "templates": (PoseSource("templates"),),
    "exact": (PoseSource("exact"),),
    "random": (PoseSource("random"),),
    "true-matrices": (PoseSource(matrices="true"),),
    # Errors are in millimetres and in degrees.
    "curve": tuple(
        PoseSource("exact", error=(error, error)) for error in (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
    ),
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

    ``poses`` are comma-separated names of :data:`SOURCES`, ``count`` the number of trials.

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
    """Run ``count`` trials of a checked task with each source of poses; return the report.

    ``folder`` receives the report and images of failures, ``video`` (.mp4 or .jpg) and ``rerun``
    films of the first trial, and ``report_progress`` a line of text after every 50 trials.

    Raises:
        UserError: A file cannot be written, the extra ``rerun`` is missing, an image cannot be
            rendered, or no grasp is reachable.
    """
    targets = ((folder / "grasps.md", (".md",)), (video, (".mp4", ".jpg")), (rerun, (".rrd",)))
    for path, suffixes in targets:
        if path is not None:
            check_target(path, suffixes)
    if rerun is not None:
        require("rerun", "--rerun", "rerun")
    if video is not None or task.renderer == "mujoco":
        open_gl(Cell(shown="solids").model, SIZE).close()  # fail now, not after all trials
    start, records = time.monotonic(), list[Record]()
    for done, trial in enumerate(run_trials(task, count, workers or available_cores()), 1):
        records += trial
        if done % BLOCK == 0:
            first = [record for record in records if record.source == task.sources[0].name]
            report_progress(f"{done} of {count}: {count_records(first).caught} caught")
    records.sort(key=lambda record: record.number)  # processes finish trials in any order
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
    worst_mm = max(record.hand_eye_mm for record in records)
    worst_deg = max(record.hand_eye_deg for record in records)
    reasons = (record.second_view for record in records if record.second_view)
    return {
        "part": task.part,
        "network": task.network and f"{task.network}, {'' if task.refine else 'not '}refined",
        "layout": task.layout,
        "renderer": task.renderer,
        "second view, first trial": next(reasons, None),
        "seed": task.seed,
        "hand-eye, worst": f"{worst_mm:.2f} mm, {worst_deg:.3f}°",
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
        yield from map(run, range(count))
        return
    with ProcessPool(pickle.dumps(run), min(workers, count)) as pool:
        for _, future in pool.run(range(count)):
            try:
                yield future.result()
            except LostWorkerError as error:
                raise RunError(str(error)) from error


def _run_trial(task: GraspTask, number: int) -> list[Record]:
    """Return the records of trial ``number``: all attempts with each pose source of the task."""
    trials = _trials(task)
    scene = trials.scene(number)
    return [attempt.record for source in task.sources for attempt in trials.attempts(scene, source)]


_trials = lru_cache(maxsize=1)(Trials)  # the models are loaded once in each process
