"""Build sources of rendered images, for training and for held-out splits, from the config."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder
from dopepp.data.formats import FileSource, hash_files
from dopepp.data.rendered import MAX_LABELLED, CachedSource, RenderedSource, Split
from dopepp.data.sample import DescribedSource
from dopepp.drawing.pictures import Size
from dopepp.experiment.assembly.build_parts import build_negatives
from dopepp.experiment.config.data_config import Cache, DataConfig, evaluation_data, stored_config
from dopepp.geometry.camera import Letterbox
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.catalogue import with_meshes
from dopepp.parts.mesh import hash_triangles
from dopepp.parts.part import Parts
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets import Preset
from dopepp.virtual.renderers import renderer_identity


def training_renders(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource:
    """Return the source of rendered training images, at the size of the network's input."""
    factory = _factory(data, parts, training_preset(data), seed, backgrounds)
    source = RenderedSource(factory, data.samples_per_epoch)
    return with_cache(source, data, data.cache, data.network_input)


def validation_windows(data: DataConfig, parts: Parts) -> DescribedSource:
    """Return rendered validation images in windows of the camera's image, as in training."""
    backgrounds = find_backgrounds(data.virtual.backgrounds, "val")
    factory = _factory(data, parts, training_preset(data), data.eval_seed, backgrounds)
    return RenderedSource(factory, data.num_val, "val")


def held_out_renders(
    data: DataConfig, parts: Parts, split: Split, scale: float = 1.0
) -> DescribedSource:
    """Return the renders of the validation or test split, at the camera's full resolution.

    The distance to the parts is divided by ``scale``.
    """
    renderer, count = data.virtual.renderer, data.num_val
    cache: Cache = "none"
    if split == "test":
        renderer, count, cache = data.test.renderer or renderer, data.num_test, data.test.cache
    preset, view = data.preset, data.virtual.view
    if view is not None:
        preset = view.whole(preset, data.virtual.camera_scale or 1.0)
    backgrounds = find_backgrounds(data.virtual.backgrounds, split)
    factory = _factory(data, parts, preset, data.eval_seed, backgrounds, renderer)
    name = "virtual" if renderer == "raster" else renderer
    return with_cache(RenderedSource(factory, count, split, name, scale), data, cache, None)


def scaled_test_renders(data: DataConfig, parts: Parts, scale: float) -> DescribedSource:
    """Return the test scenes rendered with the distance to the parts divided by ``scale``."""
    if data.is_rendered("test"):
        return held_out_renders(data, parts, "test", scale)
    raise UserError(
        f"scale={scale:g} on the images in data.root={data.root}",
        "renders, because photographs have a fixed camera",
        "leave out scale, or test on renders of these objects with data.test.renderer=raster",
    )


def validation_renders(
    checkpoint: Checkpoint, path: Path, count: int, size: Size | None = None
) -> DescribedSource:
    """Render the parts of a checkpoint as in its validation images, without its data set.

    ``path`` of the checkpoint is for messages. ``size`` (width, height), pixels, is ignored if the
    checkpoint was trained for a camera.
    """
    data = evaluation_data({}, {}, stored_config(checkpoint.data), str(path))
    virtual = replace(data.virtual, preset=data.preset_name)
    data = replace(data, root=None, objects=None, virtual=virtual, num_val=count)
    if size is not None and data.virtual.view is None:
        scene = {**(data.virtual.scene or {}), "width": size[0], "height": size[1]}
        data = replace(data, virtual=replace(data.virtual, scene=scene))
    return held_out_renders(data, with_meshes(checkpoint.parts), "val")


def with_cache(
    source: DescribedSource, data: DataConfig, cache: Cache, input_size: tuple[int, int] | None
) -> DescribedSource:
    """Cache a source's images, resized to fit ``input_size``, unless ``cache`` is ``none``."""
    if cache == "none":
        return source
    folder = None
    if cache == "disk":
        folder = cache_folder() / "renders" if data.cache_dir is None else Path(data.cache_dir)
    most = MAX_LABELLED
    if isinstance(source, RenderedSource):
        most = source.factory.preset.targets_per_image[1]
    identity = "" if folder is None else _identity(source, data.root or Path())
    return CachedSource(source, input_size, folder, identity, max_instances=most)


def _identity(source: DescribedSource, root: Path) -> str:
    """Return what determines a source's samples, and its description does not contain."""
    identity = code_hash()
    if isinstance(source, RenderedSource):
        factory = source.factory
        identity += renderer_identity(factory.renderer)
        for part in (*factory.parts, *factory.negatives):
            identity += part.appearance_hash()
            if part.mesh is not None:  # may be decimated, unlike the mesh of ``mesh_hash``
                identity += hash_triangles(part.mesh.vertices, part.mesh.faces)
    elif isinstance(source, FileSource):
        identity += hash_files(source.files(), root)
    return identity


def training_preset(data: DataConfig) -> Preset:
    """Return the scene preset with images, or windows of the camera's images, of input size."""
    preset, view = data.preset, data.virtual.view
    if view is not None:
        return view.window(preset, data.virtual.camera_scale or 1.0, data.network_input)
    box = Letterbox.fit((preset.width, preset.height), data.network_input)
    return preset.resized(box.width, box.height)


def _factory(
    data: DataConfig,
    parts: Parts,
    preset: Preset,
    seed: int,
    backgrounds: Backgrounds,
    renderer: str | None = None,
) -> Factory:
    """Return the factory that renders a preset's scenes, with parts of :func:`build_negatives`."""
    negatives, renderer = build_negatives(data, parts), renderer or data.virtual.renderer
    return Factory(parts, preset, seed, backgrounds, renderer=renderer, negatives=negatives)
