"""What ``train.py`` and ``evaluate.py`` are asked to do: their whole configs, parsed once."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Final, Literal, TypeVar

import torch

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, Range, parse, shown
from dopepp.experiment.config.data_config import Count, DataConfig, Node, Seed, Share, with_files
from dopepp.experiment.config.protocols import Protocols
from dopepp.models.layers import MAX_WIDTH, MIN_WIDTH
from dopepp.training.targets import SymmetryOptions

C = TypeVar("C", bound="MeasurementConfig")

_MOST: Final = 10**6
_MAX_EPOCHS: Final = 10**9
_MAX_WAIT_S: Final = 7 * 24 * 3600
_MIN_CELLS: Final = 0.1
"""A peak or disc narrower than this, in cells, is on no cell at all."""
_MAX_THRESHOLD: Final = 1000
"""Above any map size in cells, angle in degrees and number of peaks that means something."""

Cells = Annotated[float, Range(_MIN_CELLS, _MAX_THRESHOLD)]
Rate = Annotated[float, Range(1e-12, 1e3)]


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """The network and its loss: the node ``model``.

    Attributes:
        name: What it is called in tables.
        width: Factor on every channel count, of which the nodes below take their own.
        backbone: Node of :data:`~dopepp.models.network.BACKBONES`.
        attention: Node of :data:`~dopepp.models.network.ATTENTIONS`.
        head: Node of :data:`~dopepp.models.network.HEADS`.
        loss: Node of :data:`~dopepp.models.network.LOSSES`.
    """

    __pydantic_config__ = STRICT
    name: str
    width: Annotated[float, Range(MIN_WIDTH, MAX_WIDTH)]
    backbone: Node
    attention: Node
    head: Node
    loss: Node


@dataclass(frozen=True, kw_only=True)
class MapsConfig:
    """The target maps: a belief peak's standard deviation and the field's discs' radius, cells."""

    __pydantic_config__ = STRICT
    sigma: Cells
    field_radius: Cells


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """How and where training runs: the node ``trainer``.

    Attributes:
        accelerator: Lightning's name, or ``auto``.
        devices: How many on each machine, a list of them, ``auto`` or -1 for all.
        num_nodes: Machines.
        strategy: ``ddp`` for several processes, ``auto``, or another of Lightning's.
        precision: Lightning's name, or ``auto`` for bf16 where the hardware is fast at it.
        max_epochs: Epochs to train.
        max_steps: Steps of the optimiser to train; -1 sets no limit.
        profiler: ``simple`` or ``pytorch``.
        ddp_timeout_s: How long a process waits for one that says nothing, seconds.
        lightning: Further arguments of Lightning's Trainer, which refuses what it does not know.
    """

    __pydantic_config__ = STRICT
    accelerator: str = "auto"
    devices: Any = 1
    num_nodes: Annotated[int, Range(1, _MOST)] = 1
    strategy: str = "auto"
    precision: Any = "auto"
    max_epochs: Annotated[int, Range(1, _MAX_EPOCHS)]
    max_steps: Annotated[int, Range(-1, _MAX_EPOCHS)] = -1
    profiler: Literal["simple", "pytorch"] | None = None
    ddp_timeout_s: Annotated[float, Range(1, _MAX_WAIT_S)] = 1800.0
    lightning: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def node(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options with those that are Lightning's under ``lightning``."""
        ours = {field.name for field in fields(cls)} - {"lightning"}
        lightning = {key: value for key, value in options.items() if key not in ours}
        return {**{key: options[key] for key in options if key in ours}, "lightning": lightning}

    @property
    def num_processes(self) -> int:
        """Number of training processes on all machines.

        Raises:
            UserError: ``trainer.devices`` is wrong.
        """
        # Where torchrun has started this process, the others exist already.
        world_size = os.environ.get("WORLD_SIZE", "")
        outside = int(world_size) if world_size.isdecimal() else 1
        return max(outside, self.num_nodes * self._num_devices())

    def _num_devices(self) -> int:
        devices = self.devices
        if isinstance(devices, str) and "," in devices:
            devices = [piece for piece in devices.split(",") if piece.strip()]
        if isinstance(devices, str) and devices.lstrip("-").isdecimal():
            devices = int(devices)
        if isinstance(devices, list) and devices:
            return len(devices)
        if devices == "auto" or (devices == -1 and type(devices) is int):
            on_cpu = self.accelerator == "cpu" or not torch.cuda.is_available()
            return 1 if on_cpu else torch.cuda.device_count()
        if type(devices) is int and devices > 0:
            return devices
        allowed = "a positive number, a list of devices, auto or -1"
        raise UserError(f"trainer.devices={self.devices}", allowed, "correct it")


@dataclass(frozen=True, kw_only=True)
class CostConfig:
    """``job=cost``: frames timed one by one, from picture to poses, and the network's batch."""

    __pydantic_config__ = STRICT
    num_frames: Annotated[int, Range(1, _MOST)]
    batch_size: Annotated[int, Range(1, _MOST)]


@dataclass(frozen=True, kw_only=True)
class LearningRateConfig:
    """``job=lr_finder``: rates of the first and the last step, and the steps between them.

    Training ends earlier where the loss diverges.
    """

    __pydantic_config__ = STRICT
    min_lr: Rate
    max_lr: Rate
    num_steps: Annotated[int, Range(10, _MOST)]

    def __post_init__(self) -> None:
        if self.max_lr <= self.min_lr:
            allowed = f"above lr_finder.min_lr={self.min_lr:g}"
            raise UserError(f"lr_finder.max_lr={self.max_lr:g}", allowed, "widen the range")


@dataclass(frozen=True)
class FalsePositiveTarget:
    """How silent a network must be where its objects are not.

    Attributes:
        num_empty: Images without objects, for choosing the threshold and again for checking it.
        false_positive_rate: Share of them on which the threshold may let a detection pass; 1 sets
            no threshold.
    """

    num_empty: Count = 500
    false_positive_rate: Share = 0.005


@dataclass(frozen=True, kw_only=True)
class MeasurementConfig(FalsePositiveTarget):
    """What a training and an evaluation have in common: how a network is measured.

    Attributes:
        plain: The whole config in plain values, as it is shown and written down.
        shading, scale_factors, by, num_bins: What is measured beside the test set as it is, see
            :class:`~dopepp.experiment.config.protocols.Protocols`.
        tune: Whether to learn a factor on distances, a score and its threshold first.
        refine: ``region`` measures, and tunes, with poses refined on the picture as well, ``depth``
            where the images have depth, a list of the two by both.
        output_dir: Folder of run folders.
        extensions: Packages of one's own whose code may be used (:mod:`dopepp.core.extensions`).
    """

    __pydantic_config__ = STRICT
    plain: Mapping[str, Any] = field(default_factory=dict)
    shading: Any = None
    scale_factors: Any = None
    by: Any = None
    num_bins: Any = 5
    tune: bool
    refine: str | tuple[str, ...] | None
    output_dir: Any
    extensions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _ = self.protocols  # refuses a wrong option

    @property
    def protocols(self) -> Protocols:
        """Shading, scale and rates per bin."""
        return Protocols.of(vars(self))


@dataclass(frozen=True, kw_only=True)
class RunConfig(MeasurementConfig):
    """``train.py``'s config.

    Attributes:
        job: What is done with it.
        cost: Of ``job=cost``.
        lr_finder: Of ``job=lr_finder``.
        table: Of a multirun, how its table is laid out
            (:class:`~dopepp.experiment.results.paper.PaperTable`).
        search: Of a multirun, what a search varies (:mod:`dopepp.experiment.sweep.optuna_search`).
        recipe: Name of the loss, optimiser and schedule that were chosen together.
        seed: Of initial weights, order and training images.
        compile: Whether to compile the network with torch.
        ema: Decay of an exponential moving average of the weights; None for none.
        keep_checkpoints: Whether they stay when everything has run.
        resume: Folder of the interrupted run to go on with.
        resume_anyway: Whether to go on where what the network learns from has changed.
        init_from: Checkpoint whose weights training begins with.
        model: The network and its loss.
        maps: The target maps.
        recovery: Thresholds from maps to poses, by the names of
            :class:`~dopepp.recovery.detection.RecoveryOptions`.
        symmetry: How symmetric parts are learnt.
        data: Objects, images, and how they are rendered.
        optimizer: Node of an optimiser.
        scheduler: Node of a schedule; without a target the rate is constant.
        trainer: How and where training runs.
        callbacks: Nodes of callbacks by name, in the order in which they are called.
        logger: Nodes of experiment trackers by name.
    """

    job: Literal["train", "cost", "lr_finder"]
    cost: CostConfig
    lr_finder: LearningRateConfig
    table: Mapping[str, Any] | None
    search: Mapping[str, Any] | None = None
    recipe: str | None = None
    seed: Seed
    compile: bool
    ema: float | None
    keep_checkpoints: bool
    resume: str | None
    resume_anyway: bool
    init_from: str | None
    model: ModelConfig
    maps: MapsConfig
    recovery: Mapping[str, int | float]
    symmetry: SymmetryOptions
    data: DataConfig
    optimizer: Node
    scheduler: Node
    trainer: TrainerConfig
    callbacks: Mapping[str, Any]
    logger: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> RunConfig:
        """Read a composed and resolved config.

        Raises:
            UserError: An option is unknown, missing or wrong.
        """
        plain = {**config, "virtual": with_files(config.get("virtual"))}
        data = DataConfig.of(plain.get("data"), plain["virtual"])
        options = {key: value for key, value in plain.items() if key != "virtual"}
        options["trainer"] = TrainerConfig.node(options.get("trainer") or {})
        return replace(_parsed(cls, options), plain=plain, data=data)

    def stored_data(self) -> dict[str, Any]:
        """Return what a checkpoint says of its data: the node ``data`` with ``virtual`` in it."""
        return {**self.plain["data"], "virtual": self.plain.get("virtual")}


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(MeasurementConfig):
    """``evaluate.py``'s config.

    Attributes:
        ckpt_path: The checkpoint to measure.
        baseline: A second one, which comes first in tables.
        results: A BOP challenge CSV of another method's poses.
        method: That method's name; None takes it from the file's.
        data: Data to measure on: whole, or options to change in the checkpoint's; see
            :func:`~dopepp.experiment.config.data_config.chosen_data`.
        virtual: How to render, idem.
        bop_csv: Whether to write every method's poses as such a file.
        all_measures: Whether to print the symmetric measures of parts without symmetries, too.
        device: torch's name, or ``auto``.
        num_pictures: Images that are drawn.
    """

    ckpt_path: str | None
    baseline: str | None
    results: str | None
    method: Any = None
    data: Mapping[str, Any] | None = None
    virtual: Mapping[str, Any] | None = None
    bop_csv: bool
    all_measures: bool
    device: Any
    num_pictures: Annotated[int, Range(0, _MOST)]

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> EvaluationConfig:
        """Read a composed and resolved config.

        Raises:
            UserError: An option is unknown, missing or wrong.
        """
        return _parsed(cls, config)


def _parsed(kind: type[C], options: Mapping[str, Any]) -> C:
    """Parse a whole config."""
    if "plain" in options:
        raise UserError(
            f"plain={shown(options['plain'])}", "the options of `--cfg job`", "remove it"
        )
    return replace(parse(kind, options), plain=options)


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the leaves of nested mappings by their dotted names; lists are leaves."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from flat(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def below(key: str, nodes: Sequence[str]) -> bool:
    """Tell whether an option is one of some nodes or stands below one."""
    return any(key == node or key.startswith(f"{node}.") for node in nodes)
