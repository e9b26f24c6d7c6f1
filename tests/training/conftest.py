from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, Trainer
from torch import nn

from dopepp.data.batch import Batch
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.rendered import RenderedSource, Split
from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.maps.codec import MapGeometry
from dopepp.models.backbones import Backbone
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.heads import ChainBranch, Head
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.network import BACKBONES, HEADS, build_network
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Part
from dopepp.recovery.detection import RecoveryOptions
from dopepp.training.loggers import MetricsTable
from dopepp.training.run_checkpoints import AtomicCheckpointIO
from dopepp.training.system import PoseSystem
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS

INPUT_SIZE = (128, 128)
NOISE_SIZE = 32


class OneLayer(Backbone):
    """One convolution, because these tests do not depend on the network."""

    def __init__(self) -> None:
        super().__init__()
        self.out_channels = 4
        self.layers = nn.Sequential(nn.Conv2d(3, 4, 8, 8), nn.BatchNorm2d(4), nn.ReLU())

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.layers(images)
        return features


class Pointwise(Head):
    """One 1×1 convolution each for beliefs and field."""

    def __init__(self, in_channels: int, num_objects: int, activation: str = "identity") -> None:
        def make_branch(inputs: int, outputs: int, stage: int) -> ChainBranch:
            return ChainBranch(nn.Conv2d(inputs, outputs, 1))

        super().__init__(in_channels, num_objects, activation, 1, make_branch)


@pytest.fixture(scope="session")
def part():
    return pivconnector()


@pytest.fixture(scope="session")
def make_system(part):
    """Return a system with a network of three convolutions, for one part or two equal parts."""
    backbone, head = (f"{__name__}.{layers.__name__}" for layers in (OneLayer, Pointwise))
    BACKBONES.register(backbone)
    HEADS.register(head)

    def make(
        num_objects: int = 1, system_class: type[PoseSystem] = PoseSystem, **options: Any
    ) -> PoseSystem:
        torch.manual_seed(0)
        parts = [part, Part("other", part.cuboid, part.diameter, part.points)][:num_objects]
        loss = SpatialCrossEntropy(sigma=1.0, count_weight=1.0, field_weight=0.2)
        spec = {
            "backbone": {"_target_": backbone},
            "attention": {"_target_": "dopepp.models.attention.Identity"},
            "head": {"_target_": head},
            "activation": loss.activation,
            "num_objects": num_objects,
        }
        network = build_network(spec)
        described = Checkpoint(spec, {}, parts, INPUT_SIZE, network.stride, 1.0)
        return system_class(
            network,
            loss,
            parts,
            MapGeometry(network.stride),
            RecoveryOptions(),
            options.pop("make_optimizer", partial(torch.optim.Adam, lr=3e-3)),
            payload=described.to_payload(),
            **options,
        )

    return make


@pytest.fixture(scope="session")
def make_datamodule(part):
    """Eight training and three validation renders in batches of two."""

    def source(num_items: int, split: Split) -> RenderedSource:
        return RenderedSource(Factory([part], PRESETS["quickstart"], seed=0), num_items, split)

    def make() -> PoseDataModule:
        sources = (source(8, "train"), source(3, "val"), source(1, "test"))
        return PoseDataModule(*sources, [part.name], INPUT_SIZE, batch_size=2)

    return make


@pytest.fixture(scope="session")
def batch(make_datamodule):
    """Two rendered images, which tests must not change."""
    first: Batch = next(iter(make_datamodule().val_dataloader()))
    return first


class Noise:
    """A cheap source of images that differ in every epoch."""

    name = "noise"

    def __init__(self, num_images: int, part: Part) -> None:
        self.num_images, self.part = num_images, part

    def __len__(self) -> int:
        return self.num_images

    def sample(self, index: int, epoch: int = 0) -> Sample:
        rng = np.random.default_rng([epoch, index])
        image = rng.integers(0, 255, (NOISE_SIZE, NOISE_SIZE, 3), np.uint8)
        keypoints = rng.uniform(0, NOISE_SIZE, (9, 2))
        return Sample(image, np.eye(3), [Instance(self.part.name, np.eye(4), keypoints)])

    def describe(self) -> list[SourceInfo]:
        return []

    def contains(self, label: str) -> bool:
        return True


@pytest.fixture(scope="session")
def make_noise(part):
    """Eight training and four validation images of noise in batches of two."""

    def make() -> PoseDataModule:
        sources = [Noise(number, part) for number in (8, 4, 1)]
        return PoseDataModule(*sources, [part.name], (NOISE_SIZE, NOISE_SIZE), batch_size=2)

    return make


@pytest.fixture(scope="session")
def make_trainer():
    """Return a trainer of one epoch that logs every step to its folder's table."""

    def make(folder: Path, callbacks: Sequence[Callback], **options: Any) -> Trainer:
        table = MetricsTable(folder / "metrics.csv")
        defaults = {
            "accelerator": "cpu", "max_epochs": 1, "num_sanity_val_steps": 0, "logger": table,
            "log_every_n_steps": 1, "use_distributed_sampler": False,
            "plugins": [AtomicCheckpointIO(prepare=table.write)],
            "enable_progress_bar": False, "enable_model_summary": False,
        }  # fmt: skip
        return Trainer(default_root_dir=folder, callbacks=[*callbacks], **defaults | options)

    return make
