"""The loader: which item of which epoch comes next, and workers that report a user's mistake.

The sampler hands out (epoch, index) pairs, so persistent workers cannot go stale.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dopepp.core.errors import UserError
from dopepp.data.batch import Batch, collate
from dopepp.data.sample import Purpose, Sample, item_rng

Item = Callable[[int, int], Sample]
"""Makes item ``index`` of ``epoch``: ``item(epoch, index)``."""


class SampleDataset(Dataset[Sample | UserError]):
    """Items by (epoch, index); a user's mistake is an item too, see :class:`PoseLoader`."""

    def __init__(self, item: Item, num_items: int) -> None:
        self._item, self._num_items = item, num_items

    def __len__(self) -> int:
        return self._num_items

    def __getitem__(self, key: tuple[int, int]) -> Sample | UserError:
        """Return the item of (epoch, index)."""
        try:
            return self._item(*key)
        except UserError as error:
            return error


class EpochSampler(DistributedSampler[tuple[int, int]]):
    """Hands out (epoch, index) in an order that depends on (seed, epoch) only.

    It is a ``DistributedSampler`` so that Lightning leaves it in its place; it calls ``set_epoch``.
    Of the next pass, this rank's first ``skip`` items are left out, to resume inside an epoch.

    Args:
        shuffle: Training: a new order every epoch, and every rank gets equally many items. Without
            it the items come in order, epoch 0 always, and every item exactly once over all ranks.
    """

    def __init__(
        self, dataset: SampleDataset, seed: int, shuffle: bool, rank: int = 0, world_size: int = 1
    ) -> None:
        super().__init__(dataset, num_replicas=world_size, rank=rank, shuffle=shuffle, seed=seed)
        self._num_items, self._rank, self._world_size = len(dataset), rank, world_size
        self.skip = 0

    def __len__(self) -> int:
        if self.shuffle:
            return self._num_items // self._world_size
        return len(range(self._rank, self._num_items, self._world_size))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Go through this rank's items of the epoch that was set."""
        epoch = self.epoch if self.shuffle else 0
        order = np.arange(self._num_items)
        if self.shuffle:
            order = item_rng(self.seed, Purpose.SHUFFLE, epoch).permutation(order)
        mine = order[self._rank :: self._world_size][: len(self)]
        skip, self.skip = self.skip, 0
        return iter([(epoch, int(index)) for index in mine[skip:]])


class PoseLoader(DataLoader[Any]):
    """A ``DataLoader`` that resumes inside an epoch and raises a worker's ``UserError``.

    An exception from a worker arrives re-made from its text, with the worker's stack in it; a user
    is owed the one line. So it travels as a value and is raised here. ``object_names`` are in the
    network's order.
    """

    def __init__(
        self,
        dataset: SampleDataset,
        sampler: EpochSampler,
        object_names: Sequence[str],
        **options: Any,
    ) -> None:
        index = {name: number for number, name in enumerate(object_names)}
        super().__init__(
            dataset,
            sampler=sampler,
            collate_fn=partial(_collate, object_index=index),
            worker_init_fn=_start_worker,
            # Forked workers inherit the render cache's shared memory and the compiled kernels.
            multiprocessing_context="fork" if options.get("num_workers") else None,
            persistent_workers=bool(options.get("num_workers")),
            # Starting a pass draws a seed for the workers, which none uses: not from the generator
            # that training draws from, or a pass that is resumed would leave it elsewhere.
            generator=torch.Generator(),
            **options,
        )
        self._epoch_sampler = sampler
        self._num_batches = 0
        self._resume_at = 0

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]  # torch names its own class
        """Yield batches, from the batch where a loaded state says the pass was cut off."""
        self._num_batches, self._resume_at = self._resume_at, 0
        assert self.batch_size is not None
        self._epoch_sampler.skip = self._num_batches * self.batch_size
        for batch in super().__iter__():
            if isinstance(batch, UserError):
                break
            self._num_batches += 1
            yield batch
        else:
            return
        # The workers end here, in order. Left to the exception's traceback, which holds them in a
        # reference cycle, the collector would close their queues first and then wait for them.
        self._iterator = None
        raise batch

    def state_dict(self) -> dict[str, int]:
        """Return how many batches of this pass were handed out; Lightning stores it."""
        return {"num_batches": self._num_batches}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Start the next pass after the batches that were handed out before."""
        self._resume_at = state["num_batches"] % max(1, len(self))


def _collate(items: list[Sample | UserError], object_index: dict[str, int]) -> Batch | UserError:
    for item in items:
        if isinstance(item, UserError):
            return item
    return collate([item for item in items if isinstance(item, Sample)], object_index)


def _start_worker(worker: int) -> None:
    # One process per core is the parallelism; OpenCV's own pool would compete and dislikes forks.
    cv2.setNumThreads(0)
    # Both may be sent to the whole group. The main process decides when to stop, and a worker whose
    # main process has gone ends by itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
