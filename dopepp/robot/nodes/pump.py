"""What live nodes share: the newest picture goes to the worker, its answer out as messages.

A camera does not wait and a network takes its time, so a picture that comes while the last one is
looked at waits alone, and a newer one takes its place.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Generic, TypeVar

import numpy as np

from dopepp.robot.nodes.messages import OVERLAY, Message, Speaker, diagnosis
from dopepp.robot.nodes.worker import Stamp, Worker

RECENT: Final = 100
"""Pictures over which rates and latencies are told."""

Item = TypeVar("Item")


class Slot(Generic[Item]):
    """Hands each picture to a thread of its own; one that comes while it works replaces the last.

    Args:
        handle: What the thread does with it. What it raises ends the thread, and is raised again
            by :meth:`put` and :meth:`check`.
    """

    def __init__(self, handle: Callable[[Item], None]) -> None:
        self._handle = handle
        self._item: Item | None = None
        self._fresh, self._stopped = threading.Condition(), False
        self._error: Exception | None = None
        self.received = self.replaced = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Leave a picture, whatever was there."""
        self.check()
        with self._fresh:
            self.received += 1
            self.replaced += self._item is not None
            self._item = item
            self._fresh.notify()

    def check(self) -> None:
        """Raise what has ended the thread, if anything has."""
        if self._error is not None:
            raise self._error

    def stop(self, wait_s: float = 5.0) -> None:
        """Let the thread end once it has done what it is at."""
        with self._fresh:
            self._stopped = True
            self._fresh.notify()
        self._thread.join(wait_s)

    def _run(self) -> None:
        try:
            while True:
                with self._fresh:
                    self._fresh.wait_for(lambda: self._item is not None or self._stopped)
                    item, self._item = self._item, None
                    if item is None or self._stopped:
                        return
                self._handle(item)
        except Exception as error:
            self._error = error


class Pace:
    """How often a node answers, and how old a picture is by then."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._times: deque[float] = deque(maxlen=RECENT)
        self._latencies: deque[float] = deque(maxlen=RECENT)
        self.answered = 0

    def count(self, latency_s: float) -> None:
        """Count an answer, and how long ago its picture was taken."""
        self._times.append(self._clock())
        self._latencies.append(1000 * latency_s)
        self.answered += 1

    def values(self) -> dict[str, str]:
        """Return what a diagnosis tells; nothing of what is not known yet."""
        told = {"answered": str(self.answered)}
        if len(self._times) > 1:
            span = self._times[-1] - self._times[0]
            told["rate (1/s)"] = f"{(len(self._times) - 1) / max(span, 1e-9):.1f}"
        if self._latencies:
            told["latency, median (ms)"] = f"{np.median(self._latencies):.1f}"
            told["latency, 95 % (ms)"] = f"{np.percentile(self._latencies, 95):.1f}"
        return told


class Pump:
    """Takes a camera's messages as they come and publishes what there is on them.

    Args:
        worker: Looks at the pictures.
        topic: Theirs.
        publish: Sends a message.
        is_heard: Tells whether anybody listens to a topic.
        now: Seconds since 1970, by the clock of the stamps.
    """

    def __init__(
        self,
        worker: Worker,
        topic: str,
        publish: Callable[[Message], None],
        is_heard: Callable[[str], bool],
        now: Callable[[], float],
    ) -> None:
        self._worker, self._topic, self._publish = worker, topic, publish
        self._is_heard, self._now = is_heard, now
        self.speaker = Speaker(worker.parts)
        self._info: Any | None = None
        self._pace = Pace()
        self.slot: Slot[tuple[Any, Any | None]] = Slot(self._answer)

    def take_info(self, message: Any) -> None:
        """Take a ``camera_info``, which holds until the next."""
        self._info = message

    def take_picture(self, message: Any) -> None:
        """Take a picture; the thread looks at it as soon as it is free."""
        self.slot.put((message, self._info))

    def diagnosis(self, name: str) -> Message:
        """Return how the node of a name does."""
        self.slot.check()
        counts = {"received": self.slot.received, "replaced by newer": self.slot.replaced}
        values = {key: str(value) for key, value in counts.items()} | self._pace.values()
        now = self._now()
        stamp = Stamp(int(now), int(1e9 * (now % 1)))
        trouble = self._worker.trouble or f"no picture on {self._topic}" * (not self.slot.received)
        return diagnosis(stamp, name, trouble, values)

    def _answer(self, item: tuple[Any, Any | None]) -> None:
        answer = self._worker.take(*item, self._topic)
        if answer is None:
            return
        for message in self.speaker.messages(answer, self._is_wanted):
            self._publish(message)
        self._pace.count(self._now() - answer.stamp.seconds)

    def _is_wanted(self, topic: str) -> bool:
        return self._is_heard(topic) and (topic != OVERLAY or self._worker.settings.overlay)
