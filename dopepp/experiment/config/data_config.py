"""The config nodes ``data`` (images) and ``virtual`` (renders).

The config of a training run has both nodes. An evaluation reads both nodes from its checkpoint and
applies the user's changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, Range, parse, short_repr
from dopepp.data.rendered import MAX_ITEMS, Split
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import CameraMatrix, camera_matrix
from dopepp.virtual.presets import Preset, preset_of, resolve_base
from dopepp.virtual.presets.view import View, read_lens

Node = Mapping[str, Any]
"""``{"_target_": …, argument: …}`` for a registry; a node without target builds nothing."""
Cache = Literal["none", "memory", "disk"]
Count = Annotated[int, Range(1, MAX_ITEMS)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Share = Annotated[float, Range(0, 1)]
Side = Annotated[int, Range(8, 16384)]

_MULTIPLE: Final = 32  # both sides of the network's input are multiples of this number of pixels

AUTOMATIC: Final = (
    ("data", "input_size"),
    ("virtual", "camera_scale"),
    ("virtual", "camera"),
    ("virtual", "working_distance"),
)
"""Nodes and options whose default (null) a run replaces by a value that suits its objects."""

# Nodes to which an evaluation cannot add options.
_CLOSED: Final = ("data.jitter", "data.masking", "data.augment", "data.image_sets")


@dataclass(frozen=True, kw_only=True)
class LensConfig:
    """Pinhole camera of the application. ``camera=FILE`` sets all of these values.

    Attributes:
        width, height: Image size, pixels.
        fx, fy: Focal lengths, pixels.
        cx, cy: Principal point, pixels.
    """

    __pydantic_config__ = STRICT
    width: Side
    height: Side
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, size: Size, K: CameraMatrix) -> LensConfig:
        """Convert an image size (width, height) and a camera matrix, both in pixels."""
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        return cls(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)


@dataclass(frozen=True, kw_only=True)
class VirtualConfig:
    """Options of the renders: the node ``virtual``.

    Attributes:
        preset: Name or file of the scene preset; None selects ``ycb`` with a ``data.root``, else
            ``paper``.
        scene: Changed fields of the preset.
        backgrounds: Folder of photos, or ``skimage`` for the photos of that package; None uses
            procedural images.
        negative_photos: Folder of the user's own images without the parts. Like ``backgrounds``,
            the folder is divided between training, tuning and test.
        negatives: Parts to show that must not be detected: built-in names or mesh files. Models of
            a BOP data set that are not in ``data.objects`` are always shown.
        renderer: ``raster`` or ``photoreal``.
        camera: Camera of the application; None uses the camera of the preset.
        working_distance: Nearest and farthest distance of the parts from the camera, metres.
        camera_scale: Scale of the camera's images at the network's input; None selects a scale by
            the size of the parts in the images.
    """

    __pydantic_config__ = STRICT
    preset: str | None = None
    scene: Mapping[str, Any] | None = None
    backgrounds: str | None = None
    negative_photos: str | None = None
    negatives: tuple[str, ...] = ()
    renderer: str = "raster"
    camera: LensConfig | None = None
    working_distance: tuple[float, ...] | None = None
    camera_scale: Annotated[float, Range(0.01, 1.0)] | None = None

    @classmethod
    def of(cls, node: object) -> VirtualConfig:
        """Parse the node ``virtual``, including the camera and preset files that it names."""
        return parse(cls, with_files(node or {}), "virtual")

    @property
    def view(self) -> View | None:
        """Camera with its working distance; None unless both are known."""
        lens = self.camera
        if lens is None or self.working_distance is None:
            return None
        K = camera_matrix(lens.fx, lens.fy, lens.cx, lens.cy)
        return View((lens.width, lens.height), K, self.working_distance)

    def check_view(self) -> None:
        """Raise a UserError for a camera without a working distance, or the reverse."""
        if (self.camera is None) != (self.working_distance is None):
            missing = "camera=FILE" if self.camera is None else "working_distance=[0.3,0.8]"
            given = "working_distance" if self.camera is None else "camera"
            allowed = "camera and working_distance together, or neither"
            raise UserError(f"{given} without {missing}", allowed, f"add {missing}")


@dataclass(frozen=True, kw_only=True)
class TestConfig:
    """Options of the test images: labelled images with a ``data.root``, else renders.

    Attributes:
        renderer: Renderer of the test images; None uses the renderer of ``virtual``. A renderer
            selects renders even with a ``data.root``.
        cache: Cache of renders; ``disk`` keeps renders for the next evaluation.
    """

    __pydantic_config__ = STRICT
    renderer: str | None = None
    cache: Cache = "none"


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Objects and images: the node ``data``, including the options of the renders.

    Attributes:
        name: Name for folders and tables.
        format: Format of the labelled images: ``ycb_video``, ``bop``, ``ndds``, ``webdataset``, or
            a format of a user package.
        root: Folder of labelled images; None renders all images.
        objects: Objects of the root to learn; None selects the paper's five objects of YCB-Video,
            else all objects.
        parts: Built-in names or mesh files; used without a root and for NDDS.
        unit: Unit of the mesh files: m, cm, mm or inch; None: m for GLB, as stated in 3MF, else mm.
        symmetries: Symmetries of the objects: None for the data set's symmetries, ``none``,
            ``auto`` (within 1 % of the diameter or a pixel of ``virtual.camera``), a file, or
            symmetries by object name.
        real_fraction: Share of labelled images in an epoch.
        synthetic_fraction: Share of YCB-Video's synthetic images among the unlabelled images.
        frames: Frames of YCB-Video for training and test, instead of image sets.
        image_sets: Image set (YCB-Video) or folder (other formats) of each split ``train``, ``val``
            and ``test``; None for renders. Splits may share a folder.
        targets: BOP's list of test images; None for all images, ``auto`` for the root's list, if
            present.
        views: Number of images of a static scene from which an evaluation also estimates poses.
        classes: Part names by class name in NDDS files, if the names differ.
        download_dir: Folder for downloaded shards; None downloads nothing.
        jitter: Node of the camera jitter, if any.
        masking: Node of the random masks, if any.
        augment: Node of the photometric augmentation, if any.
        virtual: Options of the renders.
        test: Options of the test images.
        cache: Cache of training images; ``memory`` and ``disk`` render each image once.
        cache_dir: Folder of the ``disk`` cache; None uses the user's cache folder.
        samples_per_epoch: Number of images per epoch.
        num_val: Number of rendered validation images.
        num_test: Number of rendered test images.
        eval_seed: Seed of validation and test renders and of the patches of shading, independent of
            the training seed.
        input_size: Input size (width, height) of the network, pixels, multiples of 32; None selects
            a square that holds the largest part in the image of ``virtual.camera``.
        batch_size: Images per step and process.
        num_workers: Loader processes; None uses one per core.

    Raises:
        UserError: A side of ``input_size`` is not a positive multiple of 32.
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
    views: Annotated[int, Range(1, 16)] = 1
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
    num_workers: Annotated[int, Range(0, 1024)] | None

    @classmethod
    def of(cls, data: object, virtual: object) -> DataConfig:
        """Parse the nodes ``data`` and ``virtual``; None for ``virtual`` selects its defaults."""
        if isinstance(data, Mapping) and "virtual" in data:
            problem = f"data.virtual={short_repr(data['virtual'])}"
            raise UserError(problem, "virtual.…", "write virtual.… instead of data.virtual.…")
        parsed = replace(parse(cls, data, "data"), virtual=VirtualConfig.of(virtual))
        _ = parsed.preset  # raises for a wrong field before anything is rendered
        return parsed

    def __post_init__(self) -> None:
        if any(side < 1 or side % _MULTIPLE for side in self.input_size or ()):
            raise UserError(
                f"data.input_size={list(self.input_size or ())}",
                f"[width, height], each a multiple of {_MULTIPLE}",
                "round width and height up; images are letterboxed into this size",
            )

    @property
    def preset_name(self) -> str:
        """Name of the scene preset: ``virtual.preset``, or ``ycb`` with a root, else ``paper``."""
        return self.virtual.preset or ("paper" if self.root is None else "ycb")

    @property
    def preset(self) -> Preset:
        """Scene preset, including the changes of ``virtual.scene``."""
        return preset_of(self.preset_name, self.virtual.scene, "virtual.scene")

    @property
    def network_input(self) -> tuple[int, int]:
        """(width, height) of the network's input, pixels."""
        if self.input_size is None:
            raise UserError(
                "neither data.input_size nor a camera",
                "camera=FILE working_distance=[0.3,0.8], or data.input_size=[width,height]",
                "add the camera's file and the working distances in metres",
            )
        return self.input_size

    def is_rendered(self, split: Split) -> bool:
        """Return whether the images of a held-out split, ``val`` or ``test``, are renders."""
        if self.root is None or (split == "test" and self.test.renderer is not None):
            return True
        return self.image_sets[split] is None

    def image_set(self, split: Split) -> str:
        """Return the image set (YCB-Video) or folder below ``root`` (other formats) of a split."""
        chosen = self.image_sets[split]
        if chosen is None:
            raise UserError(
                f"data.image_sets.{split}=null with data.real_fraction={self.real_fraction:g}",
                "an image set, or only renders",
                f"set data.image_sets.{split}=FOLDER, or data.real_fraction=0",
            )
        return chosen


def evaluation_data(
    data: Node | None, virtual: Node | None, stored: object, source: str
) -> DataConfig:
    """Return the data config of an evaluation: the checkpoint's, with the user's changes.

    Args:
        data: Whole node ``data`` (with a ``name``), or options to change.
        virtual: Whole node ``virtual`` (with renderer and preset), or options to change.
        stored: Data config of the checkpoint; any value, because a file is not trusted.
        source: Path of the checkpoint, for messages.
    """
    given, base = data or {}, stored if isinstance(stored, dict) else {}
    whole = "name" in given  # a file of conf/data, not single options
    if not whole and not isinstance(stored, dict):
        allowed, fix = "data=… on the command line", "add the data, e.g. data=virtual"
        raise UserError(f"{source}, which contains no data config", allowed, fix)
    base, how = {key: base[key] for key in base if key != "virtual"}, base.get("virtual")
    try:
        merged = given if whole else _changed(base, given, "data")
        chosen = DataConfig.of(merged, None)
        if not virtual and how is None and not chosen.is_rendered("test"):
            return chosen
        chosen = replace(chosen, virtual=_chosen_virtual(virtual or {}, how, source))
        _ = chosen.preset
        chosen.virtual.check_view()
        return chosen
    except UserError as error:
        if whole or error.got.startswith(source):
            raise
        raise UserError(
            f"{source}, whose data config has {error.got}",
            error.allowed,
            f"{error.fix}, choose the data with data=…, or use a checkpoint written by train.py",
        ) from error


def stored_config(description: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the data config in the entry ``data`` of a checkpoint, or None without any."""
    config = description.get("config")
    return config if isinstance(config, dict) else None


def with_files(virtual: object) -> object:
    """Return the node ``virtual`` with the contents of its camera and preset files."""
    if not isinstance(virtual, Mapping):
        return virtual
    written = dict(virtual)
    if isinstance(virtual.get("camera"), str):
        written["camera"] = vars(LensConfig.of(*read_lens(virtual["camera"])))
    if isinstance(virtual.get("preset"), str):
        preset, scene = resolve_base(virtual["preset"], virtual.get("scene"))
        written |= {"preset": preset, "scene": scene}
    return written


def _chosen_virtual(given: Mapping[str, Any], stored: object, source: str) -> VirtualConfig:
    """Parse the user's node if it sets renderer and preset, else the stored node with changes."""
    if not {"renderer", "preset"} <= set(given):  # a file of conf/virtual sets both
        if stored is None:
            problem = f"{source}, which contains no options of the renders"
            raise UserError(problem, "virtual=… on the command line", "add virtual=default")
        given = _changed(stored, given, "virtual")
    return VirtualConfig.of(given)


def _changed(base: object, changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the node ``base``, of dotted name ``where``, with nested options changed."""
    if not isinstance(base, Mapping):
        fix = f"choose a file of conf/{where} with {where}=NAME"
        raise UserError(f"{where}={base!r:.100} in the checkpoint", "a mapping of options", fix)
    merged = dict(base)
    for key, value in changes.items():
        if key not in base and where in _CLOSED:
            fix = f"write one of these names after {where}."
            raise UserError(f"{where}.{key}={value}", ", ".join(base), fix)
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _changed(base[key], value, f"{where}.{key}") if nested else value
    return merged
