"""How far a render job is: a bar in a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import time
from types import TracebackType
from typing import Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

_log = logging.getLogger(__name__)

_LINE_EVERY_S: Final = 30.0


class ProgressDisplay:
    """Shows counts of images while it is entered.

    It is called as a :data:`~dopepp.data.production.produce.Progress`.

    Args:
        console: Where the bar goes; without a terminal, lines go to the log instead.
    """

    def __init__(self, console: Console) -> None:
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("rendering"),
                BarColumn(),
                MofNCompleteColumn(),
                RateColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=console,
            )
        self._task: TaskID | None = None
        self._first, self._start, self._last = 0, 0.0, 0.0

    def __enter__(self) -> ProgressDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` images are there."""
        if self._start == 0.0:
            # What an earlier run made is no part of this one's rate.
            self._first, self._start = done, time.monotonic()
            self._last = self._start
            if self._bar is not None:
                self._task = self._bar.add_task("", completed=done, total=total)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done)
        else:
            self._log_line(done, total)

    def _log_line(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last < _LINE_EVERY_S or done == self._first:
            return
        self._last = now
        rate = (done - self._first) / (now - self._start)
        left = (total - done) / rate / 60
        _log.info("%s of %s images, %.1f/s, %.0f min left", f"{done:,}", f"{total:,}", rate, left)


class RateColumn(ProgressColumn):
    """Images per second, of the last half minute."""

    def render(self, task: Task) -> Text:
        """Return the rate, or nothing while it is unknown."""
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f}/s" if speed else "", style="progress.data.speed")
