"""The nodes ``data`` and ``virtual``: which images there are, and how renders are made.

A training states both; an evaluation takes its checkpoint's, with what the user gives instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, Range, parse, shown
from dopepp.data.rendered import MAX_ITEMS, Split
from dopepp.geometry.camera import camera_matrix
from dopepp.virtual.presets import Preset, preset_of, written_out
from dopepp.virtual.presets.view import View, read_lens

Node = Mapping[str, Any]
"""``{"_target_": …, argument: …}`` for a registry; without a target there is no such thing."""
Cache = Literal["none", "memory", "disk"]
Count = Annotated[int, Range(1, MAX_ITEMS)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Share = Annotated[float, Range(0, 1)]
Side = Annotated[int, Range(8, 16384)]

MAX_WORKERS: Final = 1024
"""More loader processes than any machine here has cores: a slip of the keyboard."""

_MULTIPLE: Final = 32
"""What both sides of an input are multiples of, pixels."""

_CLOSED: Final = ("data.jitter", "data.masking", "data.augment", "data.image_sets")
"""Nodes of an evaluation's data in which every option that can be changed is there already."""


@dataclass(frozen=True, kw_only=True)
class LensConfig:
    """A camera's picture size and camera matrix, pixels, as its file states them."""

    __pydantic_config__ = STRICT
    width: Side
    height: Side
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, kw_only=True)
class VirtualConfig:
    """How renders are made: the node ``virtual``.

    Attributes:
        preset: Name of the scenes' description (:mod:`dopepp.virtual.presets`); None takes ``ycb``
            with a ``data.root``, else ``paper``.
        scene: Fields of the preset that are changed (:class:`~dopepp.virtual.presets.Preset`).
        backgrounds: Folder of photos, ``skimage`` for its own photos; None for procedural pictures.
        negatives: Parts that are shown but must not be found: built-in names or mesh files. Of a
            BOP data set, models that are none of ``data.objects`` are shown anyway.
        renderer: ``raster``, or ``photoreal``.
        camera: That the parts are to be found with; a file is read once, and its numbers stand in
            its place. None takes the preset's.
        working_distance: Of the parts from this camera, nearest and farthest, metres.
        camera_scale: By how much the network sees its pictures scaled; None chooses.
    """

    __pydantic_config__ = STRICT
    preset: str | None = None
    scene: Mapping[str, Any] | None = None
    backgrounds: str | None = None
    negatives: tuple[str, ...] = ()
    renderer: str = "raster"
    camera: LensConfig | None = None
    working_distance: tuple[float, ...] | None = None
    camera_scale: Annotated[float, Range(0.01, 1.0)] | None = None

    @classmethod
    def of(cls, node: object) -> VirtualConfig:
        """Read the node ``virtual``.

        Raises:
            UserError: An option is unknown or wrong.
        """
        return parse(cls, with_files(node or {}), "virtual")

    @property
    def view(self) -> View | None:
        """The camera at its working distance; None where the preset's camera is taken.

        Raises:
            UserError: The camera or the working distance is missing or wrong.
        """
        if self.camera is None and self.working_distance is None:
            return None
        if self.camera is None or self.working_distance is None:
            missing = "camera=FILE" if self.camera is None else "working_distance=[0.3,0.8]"
            given = "working_distance" if self.camera is None else "camera"
            raise UserError(f"{given} alone", "both, or none of the two", f"add {missing}")
        lens = self.camera
        K = camera_matrix(lens.fx, lens.fy, lens.cx, lens.cy)
        return View((lens.width, lens.height), K, self.working_distance)


@dataclass(frozen=True, kw_only=True)
class TestConfig:
    """The test images: labelled ones where there is a ``data.root``, else renders.

    Attributes:
        renderer: What draws them; None takes that of ``virtual``. One that is named here makes them
            renders also with a root.
        cache: Where renders are kept; ``disk`` keeps them for the next evaluation.
    """

    __pydantic_config__ = STRICT
    renderer: str | None = None
    cache: Cache = "none"


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Objects and images: the node ``data``, with how its renders are made.

    Attributes:
        name: Of the choice, for folders and tables.
        format: Format of the labelled images: a key of
            :data:`~dopepp.experiment.assembly.build_sources.FORMATS`.
        root: Folder of labelled images; None renders all images.
        objects: Objects of the root to learn; None takes the paper's five of YCB-Video, else all.
        parts: Built-in names or mesh files, without a root and for NDDS.
        unit: Of the mesh files: m, cm, mm or inch; None as :mod:`dopepp.parts.mesh` takes them.
        symmetries: Of the objects: None as the data set states them, else ``none``, ``auto``, a
            file, or some objects' by name (:mod:`dopepp.data.part_symmetries`).
        real_fraction: Share of labelled images in an epoch.
        synthetic_fraction: Share of YCB-Video's own synthetic images in what is not labelled.
        frames: Frames of YCB-Video for training and test alike, instead of image sets.
        image_sets: What each split takes of the root, by ``train``, ``val`` and ``test``: an image
            set of YCB-Video, of other formats a folder, which several splits may share; None
            renders the split.
        targets: BOP's list of test images to use; None takes all, ``auto`` BOP's own list where
            the root has it.
        classes: Class in NDDS files to part, where the names differ.
        download_dir: Where shards from URLs are kept; None downloads nothing.
        jitter: Node of the camera jitter; without a target there is none.
        masking: Node of the random masks; without a target there are none.
        augment: Node of the photometric augmentation; without a target there is none.
        virtual: How images are rendered.
        test: What the test images are.
        cache: ``memory`` and ``disk`` render each training image once and keep it.
        cache_dir: Folder of ``disk``; None is the user's own cache.
        samples_per_epoch: Images of an epoch.
        num_val: Rendered validation images.
        num_test: Rendered test images.
        eval_seed: Of validation and test renders and of shading's patches, so that trainings of
            several seeds are measured on the same images.
        input_size: The network's input (width, height), pixels, multiples of 32; None chooses it
            for ``virtual.camera``.
        batch_size: Images in a step, of each process.
        num_workers: Processes that load; None takes one a core.
    """

    __pydantic_config__ = STRICT
    name: str
    format: str
    root: Path | None
    objects: tuple[str, ...] | None
    parts: tuple[str, ...]
    unit: str | None
    symmetries: str | Mapping[str, Any] | None = None
    real_fraction: Share
    synthetic_fraction: Share
    frames: tuple[str, ...] | None
    image_sets: Mapping[str, str | None]
    targets: str | None = None
    classes: Mapping[str, str] | None = None
    download_dir: str | None = None
    jitter: Node = field(default_factory=dict)
    masking: Node = field(default_factory=dict)
    augment: Node = field(default_factory=dict)
    virtual: VirtualConfig = VirtualConfig()
    test: TestConfig = TestConfig()
    cache: Cache = "none"
    cache_dir: str | None = None
    samples_per_epoch: Count
    num_val: Count
    num_test: Count
    eval_seed: Seed
    input_size: tuple[int, int] | None
    batch_size: Count
    num_workers: Annotated[int, Range(0, MAX_WORKERS)] | None

    @classmethod
    def of(cls, data: object, virtual: object) -> DataConfig:
        """Read both nodes; ``virtual`` None is one that says nothing.

        Raises:
            UserError: An option is unknown, missing, of a wrong type or out of range.
        """
        if isinstance(data, Mapping) and "virtual" in data:
            problem = f"data.virtual={shown(data['virtual'])}"
            raise UserError(problem, "virtual.… alone", "set virtual.…")
        parsed = replace(parse(cls, data, "data"), virtual=VirtualConfig.of(virtual))
        _ = parsed.preset  # refuses a wrong field before anything is rendered
        return parsed

    def __post_init__(self) -> None:
        if any(side < 1 or side % _MULTIPLE for side in self.input_size or ()):
            raise UserError(
                f"data.input_size={list(self.input_size or ())}",
                f"[width, height], each a multiple of {_MULTIPLE}",
                "round up; images are letterboxed into it",
            )

    @property
    def preset_name(self) -> str:
        """Name of the scenes' description."""
        return self.virtual.preset or ("paper" if self.root is None else "ycb")

    @property
    def preset(self) -> Preset:
        """The scenes that are rendered, ``virtual.scene``'s changes included."""
        return preset_of(self.preset_name, self.virtual.scene, "virtual.scene")

    @property
    def network_input(self) -> tuple[int, int]:
        """Size of the network's input, pixels.

        Raises:
            UserError: Neither the config nor a camera states the size.
        """
        if self.input_size is None:
            raise UserError(
                "no data.input_size and no camera to choose it for",
                "camera=FILE working_distance=[0.3,0.8], or data.input_size=[width,height]",
                "add the camera's file and the distances at which it will see the part, metres",
            )
        return self.input_size

    def is_rendered(self, split: Split) -> bool:
        """Tell whether a held-out split's images are renders."""
        if self.root is None or (split == "test" and self.test.renderer is not None):
            return True
        return self.image_sets[split] is None

    def image_set(self, split: Split) -> str:
        """Return the name of a split's image set below ``root``.

        Raises:
            UserError: The split has no image set.
        """
        chosen = self.image_sets[split]
        if chosen is None:
            raise UserError(
                f"data.image_sets.{split}=null with data.real_fraction={self.real_fraction:g}",
                f"data.image_sets.{split}=FOLDER, or data.real_fraction=0 for renders alone",
                "set one of the two",
            )
        return chosen


def chosen_data(data: Node | None, virtual: Node | None, stored: object, source: str) -> DataConfig:
    """Return the data to evaluate on: the checkpoint's, with what the user gives instead.

    ``data`` and ``virtual`` are whole nodes or options to change. ``stored`` is what the checkpoint
    of the path ``source`` was trained on; it is not trusted.

    Raises:
        UserError: Neither the user nor the checkpoint names the data, or an option is wrong.
    """
    given, base = data or {}, stored if isinstance(stored, dict) else {}
    whole = "name" in given  # a file of conf/data, not single options
    if not whole and not isinstance(stored, dict):
        raise UserError(f"{source}, which names no data", "data=… on the command line", "add it")
    base, how = {key: base[key] for key in base if key != "virtual"}, base.get("virtual")
    try:
        merged = given if whole else _changed(base, given, "data")
        chosen = DataConfig.of(merged, None)
        if not virtual and how is None and not chosen.is_rendered("test"):
            return chosen
        chosen = replace(chosen, virtual=_chosen_virtual(virtual or {}, how, source))
        _ = chosen.preset
        return chosen
    except UserError as error:
        if whole or error.got.startswith(source):
            raise
        raise UserError(
            f"{source}, whose data config has {error.got}",
            error.allowed,
            f"{error.fix}, choose the data with data=…, or use a checkpoint written by train.py",
        ) from error


def trained_on(description: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the data config that a checkpoint's description names, None where it names none."""
    config = description.get("config")
    return config if isinstance(config, dict) else None


def with_files(virtual: object) -> object:
    """Return the node ``virtual`` with the contents of files in place of their paths.

    A camera's numbers replace its file, and changes to a shipped preset a file of the user's own.
    """
    if not isinstance(virtual, Mapping):
        return virtual
    written = dict(virtual)
    if isinstance(virtual.get("camera"), str):
        (width, height), K = read_lens(virtual["camera"])
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        written["camera"] = {
            "width": width,
            "height": height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
        }
    if isinstance(virtual.get("preset"), str):
        preset, scene = written_out(virtual["preset"], virtual.get("scene"))
        written |= {"preset": preset, "scene": scene}
    return written


def _chosen_virtual(given: Mapping[str, Any], stored: object, source: str) -> VirtualConfig:
    """Return how to render: a whole node as given, or the stored one with options changed."""
    if not {"renderer", "preset"} <= set(given):  # else a file of conf/virtual
        if stored is None:
            raise UserError(
                f"{source}, which does not say how to render", "virtual=default", "add it"
            )
        given = _changed(stored, given, "virtual")
    return VirtualConfig.of(given)


def _changed(base: object, changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace options, one by one also inside nodes."""
    if not isinstance(base, Mapping):
        raise UserError(f"{where}={base!r:.100}", "a mapping", "write a whole node")
    merged = dict(base)
    for key, value in changes.items():
        if key not in base and where in _CLOSED:
            raise UserError(f"{where}.{key}={value}", ", ".join(base), "check the option's name")
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _changed(base[key], value, f"{where}.{key}") if nested else value
    return merged
