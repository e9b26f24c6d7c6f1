from functools import partial

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from torch import nn

from dopepp.data.datamodule import PoseDataModule
from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import Instance, Sample
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
from tests.data.makers import MadeSource

INPUT_SIZE = (128, 128)
NOISE_SIZE = 32


class OneLayer(Backbone):
    """One convolution, because these tests do not depend on the network."""

    def __init__(self):
        super().__init__()
        self.out_channels = 4
        self.layers = nn.Sequential(nn.Conv2d(3, 4, 8, 8), nn.BatchNorm2d(4), nn.ReLU())

    def forward(self, images):
        return self.layers(images)


class Pointwise(Head):
    """One 1×1 convolution each for beliefs and field."""

    def __init__(self, in_channels: int, num_objects: int, activation: str = "identity") -> None:
        def make_branch(inputs, outputs, stage):
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

    def make(num_objects=1, system_class=PoseSystem, **options):
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
        payload = Checkpoint(spec, {}, parts, INPUT_SIZE, network.stride, 1.0).to_payload()
        options = {"make_optimizer": partial(torch.optim.Adam, lr=3e-3)} | options
        geometry, recovery = MapGeometry(network.stride), RecoveryOptions()
        return system_class(network, loss, parts, geometry, recovery, payload=payload, **options)

    return make


@pytest.fixture(scope="session")
def make_datamodule(part):
    """Eight training and three validation renders in batches of two."""

    def make():
        factory = Factory([part], PRESETS["quickstart"], seed=0)
        splits = {"train": 8, "val": 3, "test": 1}
        sources = [RenderedSource(factory, number, split) for split, number in splits.items()]
        return PoseDataModule(*sources, [part.name], INPUT_SIZE, batch_size=2)

    return make


@pytest.fixture(scope="session")
def batch(make_datamodule):
    """Two rendered images, which tests must not change."""
    return next(iter(make_datamodule().val_dataloader()))


@pytest.fixture(scope="session")
def make_noise(part):
    """Eight training and four validation images of noise in batches of two."""

    def sample(index, epoch):
        rng = np.random.default_rng([epoch, index])
        image = rng.integers(0, 255, (NOISE_SIZE, NOISE_SIZE, 3), np.uint8)
        keypoints = rng.uniform(0, NOISE_SIZE, (9, 2))
        return Sample(image, np.eye(3), [Instance(part.name, np.eye(4), keypoints)])

    def make():
        sources = [MadeSource(sample, number, part.name) for number in (8, 4, 1)]
        return PoseDataModule(*sources, [part.name], (NOISE_SIZE, NOISE_SIZE), batch_size=2)

    return make


@pytest.fixture(scope="session")
def make_trainer():
    """Return a trainer of one epoch that logs every step to its folder's table."""

    def make(folder, callbacks, **options):
        table = MetricsTable(folder / "metrics.csv")
        defaults = {
            "accelerator": "cpu", "max_epochs": 1, "num_sanity_val_steps": 0, "logger": table,
            "log_every_n_steps": 1, "use_distributed_sampler": False,
            "plugins": [AtomicCheckpointIO(prepare=table.write)],
            "enable_progress_bar": False, "enable_model_summary": False,
        }  # fmt: skip
        return Trainer(default_root_dir=folder, callbacks=[*callbacks], **defaults | options)

    return make
