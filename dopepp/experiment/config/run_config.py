"""The configs of ``train.py`` and ``evaluate.py``, parsed once.

To add a protocol of the evaluation, give :class:`Protocols` its option, write a module that
measures and records the protocol, and call the module in
:func:`dopepp.experiment.results.recording.measure_and_record`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Final, Literal, TypeVar, get_args

import torch

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, Range, check, parse, short_repr
from dopepp.experiment.config.data_config import Count, DataConfig, Node, Seed, Share, with_files
from dopepp.models.layers import MAX_WIDTH, MIN_WIDTH
from dopepp.training.targets import SymmetryOptions

C = TypeVar("C", bound="MeasurementConfig")

_MOST: Final = 10**6
_MAX_EPOCHS: Final = 10**9

AUTO: Final = "auto"  # value of `init_from` that selects the package's initial weights if they fit

Cells = Annotated[float, Range(0.1, 1000)]  # a narrower peak may cover no cell
Rate = Annotated[float, Range(1e-12, 1e3)]


QuantityName = Literal["distance", "visibility", "size", "rotation"]  # of `results.breakdown`


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """The network and its loss: the node ``model``. A node names a class and its arguments.

    Attributes:
        name: Name in tables.
        width: Factor on the channel counts of backbone and head.
        backbone: Node of the backbone.
        attention: Node of the attention module.
        head: Node of the head.
        loss: Node of the loss.
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
    """Target maps of the training.

    Attributes:
        sigma: Standard deviation of belief peaks, cells.
        field_radius: Radius of the disc around a corner that carries its vector, cells.
    """

    __pydantic_config__ = STRICT
    sigma: Cells
    field_radius: Cells


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """Options of the training process: the node ``trainer``.

    Attributes:
        accelerator: Lightning's name of the accelerator, or ``auto``.
        devices: Number of devices per machine, a list of devices, or ``auto`` or -1 for all.
        num_nodes: Number of machines.
        strategy: ``ddp`` for several processes, ``auto``, or another strategy of Lightning.
        precision: Lightning's name of the precision, or ``auto`` for bf16 on suitable hardware.
        max_epochs: Maximum number of epochs.
        max_steps: Maximum number of optimiser steps; -1 sets no limit.
        profiler: ``simple`` or ``pytorch``; None for no profile.
        ddp_timeout_s: Time that a process waits for an unresponsive process, seconds.
        lightning: Further arguments of Lightning's Trainer.
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
    ddp_timeout_s: Annotated[float, Range(1, 7 * 24 * 3600)] = 1800.0
    lightning: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def node(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options, with Lightning's own options moved below ``lightning``."""
        ours = {field.name for field in fields(cls)} - {"lightning"}
        lightning = {key: value for key, value in options.items() if key not in ours}
        return {**{key: options[key] for key in options if key in ours}, "lightning": lightning}

    @property
    def num_processes(self) -> int:
        """Number of training processes on all machines, also if torchrun has started them."""
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
        raise UserError(f"trainer.devices={self.devices}", allowed, "set e.g. trainer.devices=1")


@dataclass(frozen=True, kw_only=True)
class CostConfig:
    """Options of ``job=cost``.

    Attributes:
        num_frames: Number of timed frames, from image to poses.
        batch_size: Images per pass when the network is timed alone.
    """

    __pydantic_config__ = STRICT
    num_frames: Annotated[int, Range(1, _MOST)]
    batch_size: Annotated[int, Range(1, _MOST)]


@dataclass(frozen=True, kw_only=True)
class LearningRateConfig:
    """Options of ``job=lr_finder``, training with a learning rate that grows from step to step.

    Attributes:
        min_lr: Learning rate of the first step.
        max_lr: Learning rate of the last step.
        num_steps: Number of steps; fewer if the loss diverges.
    """

    __pydantic_config__ = STRICT
    min_lr: Rate
    max_lr: Rate
    num_steps: Annotated[int, Range(10, _MOST)]

    def __post_init__(self) -> None:
        if self.max_lr <= self.min_lr:
            allowed = f"above lr_finder.min_lr={self.min_lr:g}"
            fix = "raise lr_finder.max_lr, or lower lr_finder.min_lr"
            raise UserError(f"lr_finder.max_lr={self.max_lr:g}", allowed, fix)


@dataclass(frozen=True)
class FalsePositiveTarget:
    """Permitted rate of false positives on camera frames without objects.

    Attributes:
        num_empty: Number of frames without objects for choosing the threshold, and of other frames
            for checking the threshold.
        false_positive_rate: Largest share of these frames that may show a detection; with 1, every
            candidate is reported.
    """

    num_empty: Count = 90
    false_positive_rate: Share = 0.02


@dataclass(frozen=True)
class Protocols:
    """Measurements in addition to the accuracy on the unmodified test set."""

    shading: tuple[float, ...] = ()  # covered shares of the visible area, ascending, without 0
    scales: tuple[float, ...] = ()  # factors on the apparent size, ascending, without 1
    by: tuple[QuantityName, ...] = ()  # quantities by which the pass rates are broken down
    num_bins: int = 5  # per quantity

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Protocols:
        """Read the options from a config; ``scale_factors`` may be absent."""
        shares = "shares of the visible area from 0 to 1, not 0 alone, e.g. [0.2,0.4,0.6,0.8]"
        bounds = (1 / 20, 20)
        factors = "factors from {:g} to {:g}, not 1 alone, e.g. [0.5,1,2]".format(*bounds)
        return cls(
            shading=_levels("shading", config["shading"], (0, 1), 0, shares),
            scales=_levels("scale", config.get("scale_factors"), bounds, 1, factors),
            by=_quantities(config["by"]),
            num_bins=check("num_bins", config["num_bins"], int, Range(1, 1000)),
        )

    def __bool__(self) -> bool:
        return bool(self.shading or self.scales or self.by)


def _levels(
    option: str, value: object, bounds: tuple[float, float], standard_level: float, allowed: str
) -> tuple[float, ...]:
    """Return the ascending levels of an option, without the level that is always measured."""
    levels = [] if value is None else value if isinstance(value, list) else [value]
    numbers: list[float] = [n for n in levels if isinstance(n, int | float) and type(n) is not bool]
    wrong = len(numbers) < len(levels) or not all(bounds[0] <= n <= bounds[1] for n in numbers)
    if wrong or (value is not None and set(numbers) <= {standard_level}):
        raise UserError(f"{option}={value!r:.100}", allowed, f"set {option} to a list of these")
    return tuple(sorted({float(level) for level in numbers if level != standard_level}))


def _quantities(given: object) -> tuple[QuantityName, ...]:
    """Return the quantities in ``by``, one name or a list of names, without repetition."""
    names = [] if given is None else given if isinstance(given, list) else [given]
    quantities: dict[object, QuantityName] = {name: name for name in get_args(QuantityName)}
    wrong = [name for name in names if not isinstance(name, str) or name not in quantities]
    if wrong or (given is not None and not names):
        allowed = f"one or more of {', '.join(get_args(QuantityName))}"
        raise UserError(f"by={given!r:.100}", allowed, "set e.g. by=distance")
    return tuple(dict.fromkeys(quantities[name] for name in names))


@dataclass(frozen=True, kw_only=True)
class MeasurementConfig(FalsePositiveTarget):
    """Options that training and evaluation share.

    Attributes:
        plain: The whole config as nested dictionaries and lists, as printed and stored.
        shading: Shares of every object's visible area to cover; each share is evaluated (default:
            none).
        by: Quantities by which the pass rates are broken down: distance, visibility, size, rotation
            (default: none).
        num_bins: Number of bins of each quantity in ``by``.
        tune: Whether to tune a distance factor, a score and its threshold before the measurement.
        refine: Refinement whose poses are measured, and tuned, besides the network's: ``region`` on
            the image, ``depth`` on the depth image, or a list of both.
        output_dir: Folder of the run folders.
        extensions: Names of user packages whose code may be used.
    """

    __pydantic_config__ = STRICT
    plain: Mapping[str, Any] = field(default_factory=dict)
    shading: Any = None
    by: Any = None
    num_bins: Any = 5
    tune: bool
    refine: str | tuple[str, ...] | None
    output_dir: Any
    extensions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _ = self.protocols  # raises for a wrong option

    @property
    def protocols(self) -> Protocols:
        """Selected measurements of shading, scales and rates per bin, parsed."""
        return Protocols.of(vars(self))


@dataclass(frozen=True, kw_only=True)
class RunConfig(MeasurementConfig):
    """Config of ``train.py``.

    Attributes:
        job: ``train``, ``cost`` or ``lr_finder``.
        cost: Options of ``job=cost``.
        lr_finder: Options of ``job=lr_finder``.
        table: Layout of a multirun's table, as in ``conf/experiment/table*.yaml``.
        search: Options of a search, as in ``conf/search/optuna.yaml``.
        recipe: Name of the combination of loss, optimiser and schedule.
        seed: Seed of the initial weights, and of the content and order of the training images.
        compile: Whether to compile the network with torch.
        ema: Decay of an exponential moving average of the weights; None disables it.
        stop_at: Share of parts with a correct refined pose at which the training ends, if further
            held-out images confirm the share; None trains for all epochs.
        keep_checkpoints: Whether to keep the checkpoints after the measurement.
        resume: Folder of the interrupted run to resume.
        resume_anyway: Whether to resume even if the training data or the loss have changed.
        init_from: Checkpoint with the initial weights. ``auto``: weights learned on random parts if
            they fit the network. None: the default initialisation of the network.
        model: Network and loss.
        maps: Target maps.
        recovery: Options of the recovery from maps to poses, by the names of
            :class:`~dopepp.recovery.detection.RecoveryOptions`.
        symmetry: Treatment of symmetric parts in training.
        data: Objects, images and options of the renders.
        optimizer: Node of the optimiser.
        scheduler: Node of the schedule; without a target the learning rate is constant.
        trainer: Options of the training process.
        callbacks: Nodes of callbacks by name, in calling order.
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
    stop_at: Share | None
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
        """Parse a config that Hydra has composed and resolved."""
        plain = {**config, "virtual": with_files(config.get("virtual"))}
        data = DataConfig.of(plain.get("data"), plain["virtual"])
        options = {key: value for key, value in plain.items() if key != "virtual"}
        options["trainer"] = TrainerConfig.node(options.get("trainer") or {})
        return replace(_parsed(cls, options), plain=plain, data=data)

    def stored_data(self) -> dict[str, Any]:
        """Return the data config for a checkpoint: the node ``data`` including ``virtual``."""
        return {**self.plain["data"], "virtual": self.plain.get("virtual")}


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(MeasurementConfig):
    """Config of ``evaluate.py``.

    Attributes:
        ckpt_path: Checkpoint to measure.
        baseline: Second checkpoint, which comes first in tables.
        results: BOP challenge CSV with the poses of another method.
        templates: Nearest and farthest distance of the parts, metres, for the method that matches
            templates of their meshes; None omits the method.
        scale_factors: Factors on the apparent size of the parts; each factor is evaluated (default:
            none). ``scale`` is the short name.
        negatives: Folder of images that show none of the parts.
        negatives_camera: Camera file of these images; None for the camera of the data.
        method: Name of the method of ``results``; None derives the name from the file name.
        data: Test data: a whole node, or changes to the checkpoint's options.
        virtual: Options of the renders: a whole node, or changes to the checkpoint's options.
        bop_csv: Whether to write the poses of every method as a BOP challenge CSV.
        all_measures: Whether to print the symmetric measures of parts without symmetries.
        device: torch's name of the device, or ``auto``.
        num_pictures: Number of test images to draw.
        scale_error: Largest relative error of the parts' size or of the focal length that
            refinement assumes (default: 0.005; for templates 0.001).
    """

    ckpt_path: str | None
    baseline: str | None
    results: str | None
    templates: tuple[float, float] | None = None
    scale_factors: Any = None
    negatives: str | None = None
    negatives_camera: str | None = None
    method: Any = None
    data: Mapping[str, Any] | None = None
    virtual: Mapping[str, Any] | None = None
    bop_csv: bool
    all_measures: bool
    device: Any
    num_pictures: Annotated[int, Range(0, _MOST)]
    scale_error: Annotated[float, Range(0.0, 0.1)] | None = None

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> EvaluationConfig:
        """Parse a config that Hydra has composed and resolved."""
        return _parsed(cls, config)


def _parsed(kind: type[C], options: Mapping[str, Any]) -> C:
    """Parse a whole config, and store the unparsed config in ``plain``."""
    if "plain" in options:
        raise UserError(
            f"plain={short_repr(options['plain'])}", "the options of `--cfg job`", "leave out plain"
        )
    return replace(parse(kind, options), plain=options)


def flatten(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the leaves of nested mappings by their dotted names; lists are leaves."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from flatten(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def is_below(key: str, nodes: Sequence[str]) -> bool:
    """Return whether a dotted option is one of the nodes or lies below one of them."""
    return any(key == node or key.startswith(f"{node}.") for node in nodes)
