"""Where a training's time goes: Lightning's profilers, written into the run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from lightning.pytorch.profilers import Profiler, PyTorchProfiler, SimpleProfiler

from dopepp.errors import UserError

FOLDER: Final = "profile"
"""Where in the run folder the full report is, and with ``pytorch`` the traces for a browser."""

_FILE: Final = "report"
_US: Final = 1e-6


def make_profiler(kind: object, run_dir: Path) -> Profiler | None:
    """Build the profiler that ``trainer.profiler`` names.

    Args:
        kind: ``simple`` (hooks of the training loop), ``pytorch`` (operators, a few steps) or None.
        run_dir: The run's folder.

    Raises:
        UserError: It is something else.
    """
    if kind is None:
        return None
    kinds = {"simple": SimpleProfiler, "pytorch": PyTorchProfiler}
    if not isinstance(kind, str) or kind not in kinds:
        raise UserError(
            f"trainer.profiler={kind!r:.100}", f"null, {', '.join(kinds)}", "choose one of them"
        )
    profiler: Profiler = kinds[kind](dirpath=run_dir / FOLDER, filename=_FILE)
    return profiler


def profile_rows(profiler: Profiler, limit: int = 12) -> list[dict[str, str]]:
    """Return what took longest, a row of texts each; empty where nothing was recorded.

    Args:
        profiler: One of :func:`make_profiler`, after the training.
        limit: Rows, at most.
    """
    totals: list[tuple[str, int, float]] = []
    if isinstance(profiler, SimpleProfiler):
        recorded = profiler.recorded_durations
        totals = [(name, len(times), sum(times)) for name, times in recorded.items()]
    elif isinstance(profiler, PyTorchProfiler) and profiler.function_events:
        for one in profiler.function_events.key_averages():  # type: ignore[no-untyped-call]
            spent = one.self_cpu_time_total + one.self_device_time_total
            totals.append((str(one.key), int(one.count), _US * spent))
    totals.sort(key=lambda row: row[2], reverse=True)
    return [
        {
            "what": name,
            "calls": f"{calls:,}",
            "s": f"{seconds:.3f}",
            "ms/call": f"{1000 * seconds / max(1, calls):.2f}",
        }
        for name, calls, seconds in totals[:limit]
    ]
