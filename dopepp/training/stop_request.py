"""Ctrl-C and SIGTERM while training: remembered, and answered between two steps."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any, Final

from dopepp.data.production.stopping import Interruption


class StopRequest:
    """Takes the signals that ask a run to stop, so that it can save before it does.

    The first Ctrl-C is remembered, the second ends the run at once; schedulers repeat SIGTERM, so
    that is remembered however often it comes. Under SLURM, SIGUSR1 (``--signal=USR1@90``) asks for
    the same as SIGTERM. Processes forked from this one keep the handlers but not the request.

    Attributes:
        number: The signal that asked, SIGTERM for SIGUSR1; None as long as nobody has.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._process = os.getpid()
        self._kept: dict[int, Any] = {}

    def listen(self) -> None:
        """Take the signals over from whoever had them; in the main thread only."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in _numbers():
            self._kept[number] = signal.signal(number, self._remember)

    def end(self) -> None:
        """Give the signals back."""
        for number, handler in self._kept.items():
            signal.signal(number, handler)
        self._kept = {}

    def _remember(self, number: int, _: FrameType | None) -> None:
        if os.getpid() != self._process:  # a loader's worker: its parent decides
            return
        if number == signal.SIGINT and self.number is not None:
            raise Interruption(number)
        first = self.number is None
        self.number = signal.SIGINT if number == signal.SIGINT else signal.SIGTERM
        if first:
            # Not through a stream or a logger: the signal may have come in the middle of its own.
            os.write(2, _ANSWERS[self.number])


_ANSWERS: Final = {
    int(signal.SIGINT): b"\nsaving after this step; Ctrl-C again ends at once\n",
    int(signal.SIGTERM): b"\nasked to stop: saving after this step\n",
}


def _numbers() -> list[int]:
    numbers = [signal.SIGINT, signal.SIGTERM]
    if "SLURM_JOB_ID" in os.environ:
        numbers.append(signal.SIGUSR1)
    return [int(number) for number in numbers]
