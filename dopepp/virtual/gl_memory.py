"""What the ``gl`` renderer keeps in the GPU's memory: meshes, textures, shadow maps, targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np

from dopepp.compiled import Array
from dopepp.errors import UserError
from dopepp.virtual.raster.noise import NOISE
from dopepp.virtual.raster.shadow import ShadowMap
from dopepp.virtual.raster.texture import Texture
from dopepp.virtual.surface import Surface

_SRGB8: Final = 0x8C41
"""``GL_SRGB8``: decoded to linear light before it is filtered."""

_ANISOTROPY: Final = 16.0
"""Probes along a footprint's longer axis, as many as the rasteriser takes."""


@dataclass(frozen=True, eq=False)
class MeshMemory:
    """A surface: a vertex per corner, because normals break at creases, and its open sky.

    Attributes:
        labels: Vertex array that draws labels.
        shading: Vertex array that draws colours.
        sky_grids: Steps and first point of every triangle.
        sky_values: Shares, front sides first.
        texture: Or None.
    """

    labels: Any
    shading: Any
    sky_grids: Any
    sky_values: Any
    texture: Any


@dataclass(frozen=True, eq=False)
class Targets:
    """What is drawn into, for one image size.

    Attributes:
        labels: Framebuffer of instances and depth, a pixel each.
        samples: Framebuffer of 2×2 colours a pixel.
        image: Framebuffer of the picture.
        colours: The texture behind ``samples``.
        background: Texture of what lies behind the objects.
    """

    labels: Any
    samples: Any
    image: Any
    colours: Any
    background: Any


class Memory:
    """The memory of one context; a surface's is freed with the surface.

    Args:
        context: A ``moderngl.Context``.
        labels: Program that draws labels.
        shading: Program that draws colours.
    """

    def __init__(self, context: Any, labels: Any, shading: Any) -> None:
        self._context, self._labels, self._shading = context, labels, shading
        context.gc_mode = "auto"
        self._meshes: WeakKeyDictionary[Surface, MeshMemory] = WeakKeyDictionary()
        self._textures: WeakKeyDictionary[Texture, Any] = WeakKeyDictionary()
        self._targets: dict[tuple[int, int], Targets] = {}
        values = (NOISE / np.float32(127)).astype(np.float32)
        self.lattice = context.texture3d(NOISE.shape, 1, values, dtype="f4")

    @property
    def num_meshes(self) -> int:
        """Surfaces whose memory is held."""
        return len(self._meshes)

    def mesh(self, surface: Surface) -> MeshMemory:
        """Return a surface's memory, filled the first time."""
        found = self._meshes.get(surface)
        if found is None:
            found = self._meshes[surface] = self._upload(surface)
        return found

    def _upload(self, surface: Surface) -> MeshMemory:
        corners = surface.vertices[surface.faces].reshape(-1, 3)
        uv = np.zeros((len(corners), 2))
        if surface.texture is not None:
            uv = surface.uv[surface.faces].reshape(-1, 2)
        rows = np.concatenate([corners, surface.normals.reshape(-1, 3), uv], axis=1)
        vertices = self._context.buffer(rows.astype(np.float32))
        grids = np.column_stack([surface.sky.steps, surface.sky.firsts]).astype(np.int32)
        return MeshMemory(
            self._context.vertex_array(self._labels, [(vertices, "3f 20x", "in_position")]),
            self._context.vertex_array(
                self._shading, [(vertices, "3f 3f 2f", "in_position", "in_normal", "in_uv")]
            ),
            self._context.buffer(grids),
            self._context.buffer(np.ascontiguousarray(surface.sky.values, np.float32)),
            None if surface.texture is None else self._texture(surface.texture),
        )

    def _texture(self, texture: Texture) -> Any:
        if texture not in self._textures:
            levels = texture.images
            size = levels[0].shape[1], levels[0].shape[0]
            self.check_size(size)
            image = self._context.texture(size, 3, alignment=1, internal_format=_SRGB8)
            # The driver's halvings would mix in texels that no triangle uses.
            image.build_mipmaps()
            for number, level in enumerate(levels):
                image.write(np.ascontiguousarray(level), level=number, alignment=1)
            image.filter = self._context.LINEAR_MIPMAP_LINEAR, self._context.LINEAR
            image.anisotropy = min(_ANISOTROPY, self._context.max_anisotropy)
            self._textures[texture] = image
        return self._textures[texture]

    def shadows(self, lights: Sequence[tuple[Array, ShadowMap]], lift: float) -> tuple[Any, Any]:
        """Return the lights' table, as the shader reads it, and their shadow maps.

        Args:
            lights: Position and linear RGB at one metre of every light, and its shadow map.
            lift: Of a point before it is looked up, texels.
        """
        shapes = [shadow.inverse_depth.shape for _, shadow in lights] or [(1, 1, 1)]
        rows, columns = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
        maps = np.zeros((len(shapes), rows, columns), np.float32)
        table = np.zeros((len(shapes), 6, 4), np.float32)
        for row, layer, (light, shadow) in zip(table, maps, lights, strict=bool(lights)):
            height, width = shadow.inverse_depth.shape[:2]
            layer[:height, :width] = shadow.inverse_depth[..., 0]
            row[0], row[1, :3] = (*light[:3], lift * shadow.texel), light[3:6]
            row[2:5], row[5, :2] = shadow.P, (width, height)
        size = (columns, rows, len(maps))
        return self._context.buffer(table), self._context.texture_array(size, 1, maps, dtype="f4")

    def targets(self, size: tuple[int, int]) -> Targets:
        """Return what an image of a size is drawn into; only the last size is kept."""
        if size not in self._targets:
            self._targets = {size: self._make_targets(size)}
        return self._targets[size]

    def _make_targets(self, size: tuple[int, int]) -> Targets:
        context, double = self._context, (2 * size[0], 2 * size[1])
        self.check_size(double)
        colours = context.texture(double, 4, dtype="f2")
        instances, depth = (context.texture(size, 1, dtype=kind) for kind in ("i4", "f4"))
        return Targets(
            context.framebuffer([instances, depth], context.depth_renderbuffer(size)),
            context.framebuffer([colours], context.depth_renderbuffer(double)),
            context.framebuffer([context.texture(size, 4)]),
            colours,
            context.texture(size, 3, alignment=1),
        )

    def check_size(self, size: tuple[int, int]) -> None:
        """Refuse what the GPU has no texture for.

        Raises:
            UserError: A side is too long.
        """
        most = int(self._context.info["GL_MAX_TEXTURE_SIZE"])
        if max(size) > most:
            raise UserError(
                f"{size[0]}×{size[1]} texels for renderer 'gl' (two a pixel and axis)",
                f"at most {most} a side on this GPU",
                "render smaller images or textures, or use renderer=raster",
            )
