"""Where a training's time goes: Lightning's profilers, written into the run's folder.

To add one, a subclass of Lightning's ``Profiler`` with :meth:`totals`, and a line in
:func:`make_profiler`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from lightning.pytorch.profilers import Profiler, PyTorchProfiler, SimpleProfiler
from torch.profiler import profile

from dopepp.errors import UserError

FOLDER: Final = "profile"
"""Where in the run folder the full report is, and with ``pytorch`` the traces for a browser."""

_FILE: Final = "report"
_US: Final = 1e-6
_SHOWN: Final = 12

Total = tuple[str, int, float]
"""What took time, how often it was called, and seconds of all calls."""


class Hooks(SimpleProfiler):
    """The hooks of the training loop, over the whole training.

    Args:
        folder: Where the report is written to.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(dirpath=folder, filename=_FILE)

    def totals(self) -> list[Total]:
        """Return every hook; one that calls another one contains its time."""
        recorded = self.recorded_durations.items()
        return [(name, len(seconds), sum(seconds)) for name, seconds in recorded]


class Operators(PyTorchProfiler):
    """Torch's operators in a few steps of training and of validation, without what they call.

    Args:
        folder: Where the report and a trace of each are written to.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(dirpath=folder, filename=_FILE, on_trace_ready=self._collect)
        self._folder, self._num_traces = folder, 0
        self._totals: dict[str, tuple[int, float]] = {}

    def _collect(self, recorded: profile) -> None:
        """Add a recording; Lightning's own report is of the last one alone, a validation."""
        self._folder.mkdir(parents=True, exist_ok=True)
        recorded.export_chrome_trace(str(self._folder / f"trace_{self._num_traces}.json"))
        self._num_traces += 1
        averages: Any = recorded.key_averages()
        for one in averages:
            if one.is_user_annotation or one.key.startswith("[pl]"):
                continue  # Lightning's hooks
            calls, seconds = self._totals.get(one.key, (0, 0.0))
            spent = _US * (one.self_cpu_time_total + one.self_device_time_total)
            self._totals[one.key] = (calls + one.count, seconds + spent)

    def totals(self) -> list[Total]:
        """Return every operator; of a GPU's, launching and running together."""
        return [(name, *total) for name, total in self._totals.items()]

    def summary(self) -> str:
        """Return the report."""
        self._delete_profilers()
        lines = [
            f"{seconds:12.6f} s {calls:8d} calls  {name}"
            for name, calls, seconds in sorted(self.totals(), key=_seconds, reverse=True)
        ]
        return "\n".join(lines) + "\n"


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
    kinds: dict[str, type[Hooks] | type[Operators]] = {"simple": Hooks, "pytorch": Operators}
    if not isinstance(kind, str) or kind not in kinds:
        raise UserError(
            f"trainer.profiler={kind!r:.100}", f"null, {', '.join(kinds)}", "choose one of them"
        )
    return kinds[kind](run_dir / FOLDER)


def profile_rows(profiler: object, limit: int = _SHOWN) -> list[dict[str, str]]:
    """Return what took longest, a row of texts each; empty where nothing was recorded.

    Args:
        profiler: Of :func:`make_profiler`, after the training; of any other nothing is known.
        limit: Rows, at most.
    """
    if not isinstance(profiler, Hooks | Operators):
        return []
    totals = sorted(profiler.totals(), key=_seconds, reverse=True)
    return [
        {
            "what": name,
            "calls": f"{calls:,}",
            "s": f"{seconds:.3f}",
            "ms/call": f"{1000 * seconds / max(1, calls):.2f}",
        }
        for name, calls, seconds in totals[:limit]
    ]


def _seconds(total: Total) -> float:
    return total[2]
