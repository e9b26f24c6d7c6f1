"""Futures as they are done, and clusters that are not there."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from dopepp.core.errors import UserError
from dopepp.core.futures import completed, connect


def test_what_is_done_may_decide_what_comes_next():
    handed_out, told = [], [1]

    def items() -> Iterator[int]:
        while told and told[-1] < 1000:
            handed_out.append(told.pop())
            yield handed_out[-1]

    with ThreadPoolExecutor(1) as threads:

        def submit(item: int) -> Future[int]:
            return threads.submit(lambda: 2 * item)

        for item, future in completed(submit, items(), lambda: 1):
            assert future.result() == 2 * item
            told.append(future.result())
    assert handed_out == [2**power for power in range(10)]


def test_no_more_is_handed_out_than_there_is_room():
    flying: list[Future[int]] = []

    def submit(item: int) -> Future[int]:
        future: Future[int] = Future()
        flying.append(future)
        assert sum(not one.done() for one in flying) <= 3
        if sum(not one.done() for one in flying) == 3 or item == 9:
            for one in reversed(flying):
                if not one.done():
                    one.set_result(item)
        return future

    done = [item for item, _ in completed(submit, iter(range(10)), lambda: 3)]
    assert sorted(done) == list(range(10))


def test_without_ray_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"--engine ray without .* pip install 'dopepp\[ray\]'"):
        connect(None, 1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "127.0.0.1:99999999", "a:b"])
def test_an_address_without_a_cluster_is_refused_at_once(address):
    pytest.importorskip("ray")
    with pytest.raises(UserError, match=f"--ray-address {address}: .*ray start --head"):
        connect(address, 1)
