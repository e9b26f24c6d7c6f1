"""The OpenGL renderer, for machines with a GPU (extra ``gl``): the rasteriser's look and labels.

The GPU draws labels at pixel centres, and colours at 2×2 samples a pixel in the rasteriser's
places. Textures, baked open sky, shadow maps, materials and the tone curve are the rasteriser's
own. What differs: every sample is shaded, where the rasteriser shades a pixel's patch once;
textures are filtered by the GPU (mip-maps of the same levels, anisotropic); and edges are rounded
to the GPU's grid. Shadow maps, the plane's darkening and the visible fractions are computed on the
processor, so one core limits the rate.

Only hardware is used, and only in processes that were not forked: see ``gl_context``. A context
belongs to the thread that first renders with it.
"""

from __future__ import annotations

import threading
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Int16, UInt8

from dopepp.compiled import Array
from dopepp.virtual.gl_context import check_process, open_context, require_moderngl
from dopepp.virtual.gl_memory import Memory, MeshMemory, Targets
from dopepp.virtual.gl_shaders import FULL_SCREEN, HEADER, LABELS, RESOLVE, SHADING, VERTEX
from dopepp.virtual.raster.coverage import fractions_of
from dopepp.virtual.raster.plane import darken_plane, inverse_depth_of, plane_depth
from dopepp.virtual.raster.projection import project_object
from dopepp.virtual.raster.shading import LIFT_TEXELS, SHARPEST, ambient_row
from dopepp.virtual.raster.shadow import ShadowMap, shadow_maps
from dopepp.virtual.scene import NEAR, Rendered, Scene, SceneObject

require_moderngl()

_NOWHERE: Final = (0.0, 0.0, 0.0, -1.0)
"""A plane that every point is above."""


def render(scene: Scene, admit_software: bool | None = None) -> Rendered:
    """Render a scene with 2×2 anti-aliasing; one without objects is its background.

    Args:
        scene: The scene.
        admit_software: See :func:`~dopepp.virtual.gl_context.open_context`; it counts when the
            thread renders for the first time.

    Raises:
        UserError: There is no hardware renderer, the process was forked, or the image is too
            large for the GPU.
    """
    check_process()
    renderer = getattr(_kept, "renderer", None)
    if renderer is None:
        renderer = _kept.renderer = Renderer(open_context(admit_software))
    rendered: Rendered = renderer.render(scene)
    return rendered


_kept = threading.local()


class Renderer:
    """Programs and memory of one context.

    Args:
        context: A ``moderngl.Context``, used by one thread.
    """

    def __init__(self, context: Any) -> None:
        self._context = context
        context.front_face = "cw"  # rows run downwards
        shaded = HEADER + "#define SHADED\n"
        self._labels = context.program(HEADER + VERTEX, HEADER + LABELS)
        self._shading = context.program(shaded + VERTEX, HEADER + SHADING)
        self._resolving = context.program(HEADER + FULL_SCREEN, HEADER + RESOLVE)
        self._screen = context.vertex_array(self._resolving, [])
        self._memory = Memory(context, self._labels, self._shading)

    @property
    def num_meshes(self) -> int:
        """Meshes in the GPU's memory."""
        return self._memory.num_meshes

    def render(self, scene: Scene) -> Rendered:
        """Render a scene."""
        image = scene.background.copy()
        depth = np.zeros(image.shape[:2], np.float32)
        instances = np.full(image.shape[:2], -1, np.int16)
        if scene.plane is not None:
            plane_depth(inverse_depth_of(scene.plane, scene.K), NEAR, depth)
        projected = [project_object(item, scene.K) for item in scene.objects]
        if scene.objects:
            lights = shadow_maps(scene, projected)
            if scene.plane is not None:
                nothing = np.empty((0, 0, 0), np.int32)
                darken_plane(scene, scene.plane, lights, ambient_row(scene), (0, 0), nothing, image)
            with self._context:
                seen = [
                    (number, item, self._memory.mesh(item.surface))
                    for number, item in enumerate(scene.objects)
                    if projected[number].box(scene.size) is not None
                ]
                targets = self._memory.targets(scene.size)
                self._draw_labels(scene, seen, targets, depth, instances)
                image = self._draw_colours(scene, seen, lights, targets, image)
        return Rendered(image, depth, instances, fractions_of(scene, projected, instances), scene)

    def _draw_labels(
        self,
        scene: Scene,
        seen: list[tuple[int, SceneObject, MeshMemory]],
        targets: Targets,
        depth: Float32[np.ndarray, "height width"],
        instances: Int16[np.ndarray, "height width"],
    ) -> None:
        """Write what pixel centres see of the objects."""
        self._begin(self._labels, scene, targets.labels)
        for number, item, mesh in seen:
            self._labels["number"] = number + 1  # the buffer is cleared to 0
            self._place(self._labels, item)
            mesh.labels.render()
        shape = depth.shape
        numbers = targets.labels.read(components=1, attachment=0, dtype="i4")
        depths = targets.labels.read(components=1, attachment=1, dtype="f4")
        found = np.frombuffer(numbers, np.int32).reshape(shape)
        drawn = np.frombuffer(depths, np.float32).reshape(shape)
        instances[:] = found - 1
        np.copyto(depth, drawn, where=found > 0)

    def _draw_colours(
        self,
        scene: Scene,
        seen: list[tuple[int, SceneObject, MeshMemory]],
        lights: list[tuple[Array, ShadowMap]],
        targets: Targets,
        behind: UInt8[np.ndarray, "height width 3"],
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return the objects' picture over what lies behind them."""
        program = self._shading
        self._begin(program, scene, targets.samples)
        program["focal"] = float(scene.K[0, 0]), float(scene.K[1, 1])
        ambient = scene.ambient
        program["up"], program["above"], program["below"] = ambient.up, ambient.above, ambient.below
        program["num_lights"] = len(lights)
        program["image"], program["shadows"], program["lattice"] = 0, 1, 2
        table, maps = self._memory.shadows(lights, LIFT_TEXELS)
        table.bind_to_storage_buffer(0)
        maps.use(1)
        self._memory.lattice.use(2)
        for _, item, mesh in seen:
            self._place(program, item)
            _set_material(program, item)
            program["textured"] = mesh.texture is not None
            if mesh.texture is not None:
                mesh.texture.use(0)
            mesh.sky_grids.bind_to_storage_buffer(1)
            mesh.sky_values.bind_to_storage_buffer(2)
            mesh.shading.render()
        targets.background.write(np.ascontiguousarray(behind), alignment=1)
        targets.image.use()
        self._context.disable(self._context.DEPTH_TEST | self._context.CULL_FACE)
        self._resolving["samples"], self._resolving["background"] = 0, 1
        targets.colours.use(0)
        targets.background.use(1)
        self._screen.render(vertices=3)
        pixels = np.frombuffer(targets.image.read(components=3, alignment=1), np.uint8)
        return pixels.reshape(behind.shape).copy()

    def _begin(self, program: Any, scene: Scene, target: Any) -> None:
        """Clear a target and set what all objects of a scene share."""
        target.use()
        target.clear()
        self._context.enable(self._context.DEPTH_TEST)
        program["K"].write(np.ascontiguousarray(scene.K.T, np.float32))
        program["image_size"], program["near"] = scene.size, NEAR
        plane = scene.plane
        program["plane"] = _NOWHERE if plane is None else (*plane.normal, plane.offset)

    def _place(self, program: Any, item: SceneObject) -> None:
        """Set an object's pose, and whether its back faces are drawn."""
        program["T_cam_obj"].write(np.ascontiguousarray(item.T_cam_obj.T, np.float32))
        if item.surface.closed:
            self._context.enable(self._context.CULL_FACE)
        else:
            self._context.disable(self._context.CULL_FACE)


def _set_material(program: Any, item: SceneObject) -> None:
    """Set what an object is made of."""
    material = item.material
    program["colour"] = material.colour
    program["alpha0"] = max(material.roughness**2, SHARPEST)
    program["specular"], program["metallic"] = material.specular, material.metallic
    program["noise"] = material.noise, material.noise_pitch
    grooves = material.grooves
    if grooves is None:
        program["groove"] = 1.0, 0.0, 0.0, 0.0
        return
    axis = item.T_cam_obj[:3, :3] @ np.array(grooves.axis, np.float64)
    program["groove_axis"] = tuple(float(value) for value in axis)
    origin = float(axis @ item.T_cam_obj[:3, 3])
    program["groove"] = grooves.pitch, grooves.slope, grooves.irregularity, origin
