"""The newest picture alone is handed on, and a thread that fails is not silent."""

import threading

import pytest

from dopepp.robot.nodes.ros2 import Pace, Slot


def test_whoever_is_slow_gets_the_newest():
    begun, go_on, done = threading.Event(), threading.Event(), threading.Event()
    taken = []

    def handle(item):
        taken.append(item)
        begun.set()
        go_on.wait(10)
        if item == 9:
            done.set()

    slot = Slot(handle)
    slot.put(0)
    assert begun.wait(10)
    for item in range(1, 10):
        slot.put(item)
    go_on.set()
    assert done.wait(10)
    slot.stop()
    assert taken == [0, 9]
    assert (slot.received, slot.replaced) == (10, 8)


def test_what_its_thread_raises_is_raised():
    slot = Slot(lambda item: 1 / item)
    slot.put(0)
    slot._thread.join(10)
    for call in (slot.check, lambda: slot.put(1)):
        with pytest.raises(ZeroDivisionError):
            call()


def test_pace_tells_rate_and_latency():
    seconds = iter(range(100))
    pace = Pace(lambda: next(seconds) / 10)
    assert pace.values() == {"answered": "0"}
    for latency in (0.01, 0.02, 0.03):
        pace.count(latency)
    told = pace.values()
    assert told["rate (1/s)"] == "10.0"
    assert told["latency, median (ms)"] == "20.0"
