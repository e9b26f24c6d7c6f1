"""Turn sources into batches for training and validation; one seed determines all batches.

The sampler yields (epoch, index) pairs, so persistent workers never use an old epoch. The loader
resumes inside an epoch and raises the user errors of workers.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import cv2
import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dopepp.core.errors import UserError
from dopepp.data.batch import Batch, collate
from dopepp.data.sample import (
    DescribedSource,
    Purpose,
    Sample,
    SourceInfo,
    item_rng,
    letterbox_sample,
    pad_sample,
    resize_sample,
)
from dopepp.data.transforms.augment import Photometric
from dopepp.data.transforms.jitter import CameraJitter
from dopepp.data.transforms.masking import RandomMask
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import Letterbox, focal_length, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.parts.part import Part
from dopepp.parts.size import LearnedRange, enclosing_range
from dopepp.virtual.backgrounds import Backgrounds

_MAX_MEASURED: Final = 200  # images of a source in which the parts' sizes are measured


class PoseDataModule(LightningDataModule):
    """Training, validation and test data for pose estimation.

    Training items are resized, jittered, masked, augmented and padded; validation items are only
    letterboxed; test items keep their resolution. Only training items depend on the epoch.

    Args:
        input_size: (width, height) of the network's input, pixels.
        backgrounds: Images for the masking of objects that fill their image; required with
            ``masking``.
        val_images: Whole images of the camera, if ``val`` shows windows of them.

    Raises:
        UserError: The training source has fewer images than a batch.
    """

    def __init__(
        self,
        train: DescribedSource,
        val: DescribedSource,
        test: DescribedSource,
        object_names: Sequence[str],
        input_size: Size,
        batch_size: int,
        num_workers: int = 0,
        seed: int = 0,
        jitter: CameraJitter | None = None,
        masking: RandomMask | None = None,
        augment: Photometric | None = None,
        backgrounds: Backgrounds | None = None,
        val_images: DescribedSource | None = None,
    ) -> None:
        super().__init__()
        if masking is not None and backgrounds is None:
            raise ValueError("masking requires backgrounds, for objects that fill their image")
        if len(train) < batch_size:
            problem = f"{len(train)} training images for batches of {batch_size}"
            fix = "lower data.batch_size or raise data.samples_per_epoch"
            raise UserError(problem, "at least one full batch per epoch", fix)
        self.train_source, self.val_source, self.test_source = train, val, test
        self.val_images = val if val_images is None else val_images
        self.object_names, self.input_size = list(object_names), input_size
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self._jitter, self._masking, self._augment = jitter, masking, augment
        self._backgrounds = backgrounds

    def train_item(self, epoch: int, index: int) -> Sample:
        """Return a training item, which depends only on (seed, epoch, index)."""
        # Padding comes last: as in prediction, it has no noise and is not used as background.
        sample = resize_sample(self.train_source.sample(index, epoch), self.input_size)
        rng = item_rng(self.seed, Purpose.AUGMENT, epoch, index)
        if self._jitter is not None:
            sample = self._jitter(sample, rng)
        if self._masking is not None and self._backgrounds is not None:
            sample = self._masking(sample, rng, self._backgrounds)
        if self._augment is not None:
            sample = replace(sample, image=self._augment(sample.image, rng))
        return pad_sample(sample, self.input_size)

    def val_item(self, epoch: int, index: int) -> Sample:
        """Return a validation item, letterboxed to ``input_size``."""
        return letterbox_sample(self.val_source.sample(index, epoch), self.input_size)

    def train_dataloader(self) -> PoseLoader:
        """Return the loader of batches in random order; the last incomplete batch is dropped."""
        loader = self._loader(self.train_item, self.train_source, shuffle=True)
        if not len(loader):
            problem = f"{len(self.train_source)} training images for processes with batches of "
            fix = "lower data.batch_size or trainer.devices, or raise data.samples_per_epoch"
            allowed = "at least one full batch per process and epoch"
            raise UserError(f"{problem}{self.batch_size}", allowed, fix)
        return loader

    def val_dataloader(self) -> PoseLoader:
        """Return the loader of batches in order; all ranks together yield each item once."""
        loader = self._loader(self.val_item, self.val_source, shuffle=False)
        if not loader.num_common_batches:
            problem = f"{len(self.val_source)} validation images for more processes"
            fix = "raise data.num_val, or lower trainer.devices"
            raise UserError(problem, "at least one validation image per process", fix)
        return loader

    def _loader(self, item: Item, source: DescribedSource, shuffle: bool) -> PoseLoader:
        dataset, trainer = SampleDataset(item, len(source)), self.trainer
        ranks = (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)
        return PoseLoader(
            dataset,
            EpochSampler(dataset, self.seed, shuffle, *ranks),
            self.object_names,
            batch_size=self.batch_size,
            drop_last=shuffle,
            num_workers=self.num_workers,
            pin_memory=torch.cuda.is_available(),
        )

    def check_objects(self) -> None:
        """Raise a UserError if an object to learn is in no training source."""
        missing = [name for name in self.object_names if not self.train_source.contains(name)]
        if missing:
            sources = ", ".join(info.name for info in self.train_source.describe())
            problem = f"no instance of {', '.join(missing)} in the training data ({sources})"
            fix = "leave the object out, or add a source that shows it (e.g. renders)"
            raise UserError(problem, "objects with at least one instance in a training source", fix)

    def size_ranges(self, parts: Sequence[Part]) -> dict[str, LearnedRange]:
        """Measure each part's range of size (pixels of the input) and depth (metres), by name.

        The first 200 validation images are measured, then training images for parts that they lack.
        Instances that are less than 10 % visible are ignored.
        """
        views: dict[str, list[LearnedRange]] = {part.name: [] for part in parts}
        for source in (self.val_source, self.train_source):
            missing = [part for part in parts if not views[part.name]]
            for index in range(min(len(source), _MAX_MEASURED) if missing else 0):
                sample = source.sample(index)
                scale = Letterbox.fit(sample.size, self.input_size).scale_x
                for part, instance in itertools.product(missing, sample.instances):
                    depth = float(transform(instance.T_cam_obj, part.cuboid[CENTROID])[2])
                    is_seen = instance.visible_fraction >= MIN_VISIBLE_FRACTION and depth > 0
                    if instance.label == part.name and is_seen:
                        pixels = scale * focal_length(sample.K) * part.diameter / depth
                        views[part.name].append(LearnedRange.of(pixels, depth))
        return {name: enclosing_range(sizes) for name, sizes in views.items() if sizes}

    def summary(self) -> list[tuple[str, SourceInfo]]:
        """Return (split, description) of each source, for the log at the start of training."""
        splits = {"train": self.train_source, "val": self.val_source, "test": self.test_source}
        return [(split, info) for split, source in splits.items() for info in source.describe()]

    def fingerprint(self) -> str:
        """Return the SHA-256 (hex) of the seed and all sources' names, lengths and identities."""
        record: dict[str, list[object]] = {"train": [], "val": [], "test": []}
        for split, info in self.summary():
            record[split].append([info.name, info.num_images, dict(info.identity)])
        text = json.dumps({"seed": self.seed, **record}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


Item = Callable[[int, int], Sample]  # function of epoch and index that makes a sample


class SampleDataset(Dataset[Sample | UserError]):
    """The ``num_items`` samples of an epoch, indexed by (epoch, index).

    A ``UserError`` is returned instead of raised; :class:`PoseLoader` raises the error.
    """

    def __init__(self, item: Item, num_items: int) -> None:
        self._item, self._num_items = item, num_items

    def __len__(self) -> int:
        return self._num_items

    def __getitem__(self, key: tuple[int, int]) -> Sample | UserError:
        try:
            return self._item(*key)
        except UserError as error:
            return error


class EpochSampler(DistributedSampler[tuple[int, int]]):
    """Sampler of (epoch, index) pairs in an order that depends only on (seed, epoch).

    Lightning keeps a ``DistributedSampler`` and calls its ``set_epoch``. To resume inside an epoch,
    the next pass skips this rank's first ``skip`` items.

    Args:
        shuffle: Whether each epoch has a new order, with equally many items per rank. Otherwise the
            items of epoch 0 come in order, each exactly once over all ranks.
    """

    def __init__(
        self, dataset: SampleDataset, seed: int, shuffle: bool, rank: int = 0, world_size: int = 1
    ) -> None:
        super().__init__(dataset, num_replicas=world_size, rank=rank, shuffle=shuffle, seed=seed)
        self._num_items, self._rank, self._world_size = len(dataset), rank, world_size
        self.num_common_items = self._num_items // world_size  # items that every rank has
        self.skip = 0

    def __len__(self) -> int:
        if self.shuffle:
            return self.num_common_items
        return len(range(self._rank, self._num_items, self._world_size))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, order = self.epoch if self.shuffle else 0, np.arange(self._num_items)
        if self.shuffle:
            order = item_rng(self.seed, Purpose.SHUFFLE, epoch).permutation(order)
        items_of_rank = order[self._rank :: self._world_size][: len(self)]
        skip, self.skip = self.skip, 0
        return iter([(epoch, int(index)) for index in items_of_rank[skip:]])


class PoseLoader(DataLoader[Any]):
    """A ``DataLoader`` that resumes inside an epoch and raises a worker's ``UserError``.

    Workers return the error as a value, because ``DataLoader`` turns exceptions into text.
    ``object_names`` are in the network's order; ``options`` are those of ``DataLoader``.
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
            # A pass draws an unused seed for the workers. A separate generator keeps this draw out
            # of the training's generator, which must be the same after resuming.
            generator=torch.Generator(),
            **options,
        )
        self._epoch_sampler = sampler
        self._num_batches = self._resume_at = 0

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]  # torch names its own class
        """Yield the batches of an epoch; after a state was loaded, only its remaining batches."""
        self._num_batches, self._resume_at = self._resume_at, 0
        assert self.batch_size is not None
        self._epoch_sampler.skip = self._num_batches * self.batch_size
        for batch in super().__iter__():
            if isinstance(batch, UserError):  # a worker returns its error in place of a batch
                break
            self._num_batches += 1
            yield batch
        else:
            return
        # This ends the workers cleanly. Otherwise the exception's traceback keeps them in a
        # reference cycle, and the collector closes their queues before they have ended.
        self._iterator = None
        raise batch

    @property
    def num_common_batches(self) -> int:
        """Number of batches that every rank has; without shuffling, ranks may have one more."""
        assert self.batch_size is not None
        return math.ceil(self._epoch_sampler.num_common_items / self.batch_size)

    def state_dict(self) -> dict[str, int]:
        """Return the number of yielded batches of this pass, which Lightning stores."""
        return {"num_batches": self._num_batches}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Start the next pass after the number of batches in ``state``."""
        self._resume_at = state["num_batches"] % max(1, len(self))


def _collate(items: list[Sample | UserError], object_index: dict[str, int]) -> Batch | UserError:
    """Stack samples to a batch, or return the first error among the samples."""
    errors = [item for item in items if isinstance(item, UserError)]
    samples = [item for item in items if isinstance(item, Sample)]
    return errors[0] if errors else collate(samples, object_index)


def _start_worker(worker: int) -> None:
    """Prepare a worker process of the data loader: no OpenCV threads, no signal handling."""
    # The workers use all cores; OpenCV's threads would compete and do not survive forks.
    cv2.setNumThreads(0)
    # Signals may reach the whole process group. The main process decides when to stop, and workers
    # end when it has ended.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
