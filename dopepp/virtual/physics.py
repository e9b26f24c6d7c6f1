"""Rigid bodies in MuJoCo (extra ``robot``): hulls for collisions, and solids that fall and settle.

Piles are simulated at a size at which the largest solid measures ``_SIZE``, so that one time step
and one damping fit parts of all sizes. The motion is damped, because only the pile at rest matters.
"""

from __future__ import annotations

import ctypes.util
import hashlib
import io
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder, write_file
from dopepp.geometry.camera import make_transform, transform
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.parts.convex import Piece, hull_faces

# MuJoCo selects an OpenGL backend at import: a window's, or EGL without a display. Without
# EGL the import would fail, so rendering is switched off; the simulation works.
if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & {*os.environ}:
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "off"

# MuJoCo loads PyOpenGL, which advertises an accelerator package.
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)

import mujoco  # noqa: E402

_log = logging.getLogger(__name__)

Poses = Float[np.ndarray, "solids 4 4"]

MAX_OVERLAP: Final = 0.008
"""Largest depth to which solids at rest overlap, diameters of the largest solid."""

_SIZE: Final = 0.1  # diameter of the largest simulated solid, metres
_STEP: Final = 0.004  # time step, seconds
_DRAG: Final = 16.0  # damping rate, 1/s: solids fall at no more than 0.6 m/s
_MAX_DRAG: Final = 300.0  # reached by doubling in every window once solids have landed, 1/s
_WINDOW: Final = 0.1  # duration over which the motion is measured, seconds
_REST: Final = 0.01  # largest motion at rest in a window, diameters; a fall at _MAX_DRAG is 0.03
_LANDED: Final = 0.1  # largest motion in a window once solids have landed, diameters
_LONGEST: Final = 1.0  # a pile that moves longer at the largest drag is rejected, seconds
_MAX_WINDOWS: Final = 300  # a tower of 100 solids falls for 17 seconds
_FRICTION: Final = (0.4, 0.005, 0.0001)  # sliding, torsional and rolling
_FLOOR, _HULL, _PIECES = 1, 2, 4  # collision groups


def add_hull(spec: Any, body: Any, name: str, vertices: Piece) -> Any:
    """Add a convex hull to a MuJoCo body and return its geom; geoms of one name share a mesh."""
    if spec.mesh(name) is None:
        faces = hull_faces(ConvexHull(vertices))
        spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def settle(
    solids: Sequence[tuple[Piece, ...]], starts: Poses, walls: Sequence[Piece], diameter: float
) -> Poses | None:
    """Drop solids onto the plane z = 0, and return their poses at rest.

    Results are cached on disk under a hash of all arguments.

    Args:
        solids: Convex pieces of every solid, object frame, metres.
        starts: Initial poses (object to world, metres) without overlaps.
        walls: Immovable convex pieces, world frame, metres.
        diameter: Diameter of the largest solid, metres.

    Returns:
        Poses like ``starts``, or None if the solids do not come to rest, or overlap by more than
        :data:`MAX_OVERLAP`.

    Raises:
        UserError: The cached result is damaged.
    """
    digest = hashlib.sha256(Path(__file__).read_bytes() + mujoco.__version__.encode())
    distinct = {id(solid): solid for solid in solids}  # most solids are copies of one part
    pieces = [piece for solid in distinct.values() for piece in solid]
    counts = np.array([len(solid) for solid in distinct.values()])
    order = list(distinct)
    kinds = np.array([order.index(id(solid)) for solid in solids])
    for array in (*pieces, *walls, starts, counts, kinds, np.array([len(walls), diameter])):
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    path = cache_folder() / "piles" / f"{digest.hexdigest()[:24]}.npy"
    if path.is_file():
        try:
            poses = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            fix = "delete this file; the next run creates the file again"
            raise UserError(f"{path}: {error}", "a file written by dopepp", fix) from error
    else:
        settled = _simulate(solids, starts, walls, diameter)
        poses = np.empty((0, 4, 4)) if settled is None else settled
        content = io.BytesIO()
        np.save(content, poses, allow_pickle=False)
        try:
            write_file(path, content.getvalue())
        except OSError as error:
            _log.warning("%s cannot be written, so the poses are not cached: %s", path, error)
    return poses if len(poses) == len(starts) else None


def _simulate(
    solids: Sequence[tuple[Piece, ...]], starts: Poses, walls: Sequence[Piece], diameter: float
) -> Poses | None:
    """Simulate the fall of solids; return their poses at rest, or None if they keep moving."""
    scale = _SIZE / diameter
    model = _model(solids, walls, scale)
    state = mujoco.MjData(model)
    for row, pose in zip(state.qpos.reshape(-1, 7), starts, strict=True):
        row[:3], row[3:] = scale * pose[:3, 3], matrix_to_quaternion(pose[:3, :3])
    ends = [scale * _hull(solid) for solid in solids]
    # Positions of all vertices are compared after every window of simulated time.
    positions, drag = _vertex_positions(starts, ends), _DRAG
    windows_left = round(_LONGEST / _WINDOW)
    for _ in range(_MAX_WINDOWS):
        inertia = model.body_inertia[1:].max(axis=1)
        damping = np.stack([*[model.body_mass[1:]] * 3, *[inertia] * 3], axis=1)
        model.dof_damping[:] = drag * damping.ravel()
        mujoco.mj_step(model, state, round(_WINDOW / _STEP))
        mujoco.mj_forward(model, state)
        frames = zip(state.xmat[1:], state.xpos[1:], strict=True)
        poses = np.stack([make_transform(R.reshape(3, 3), position) for R, position in frames])
        moved = _vertex_positions(poses, ends)
        motion = np.linalg.norm(moved - positions, axis=1).max()
        overlap = -state.contact.dist.min(initial=0.0)
        if motion < _REST * _SIZE and overlap < MAX_OVERLAP * _SIZE:
            poses[:, :3, 3] /= scale
            return poses
        positions = moved
        windows_left -= drag == _MAX_DRAG
        if not windows_left:
            break
        if drag > _DRAG or motion < _LANDED * _SIZE:
            drag = min(2 * drag, _MAX_DRAG)
    return None


def _vertex_positions(poses: Poses, vertices: Sequence[Piece]) -> Float[np.ndarray, "vertices 3"]:
    """Return the vertices of all solids in the world frame."""
    pairs = zip(poses, vertices, strict=True)
    return np.concatenate([transform(pose, solid) for pose, solid in pairs])


def _hull(solid: tuple[Piece, ...]) -> Piece:
    """Return the vertices of a solid's convex hull."""
    vertices = np.concatenate(solid)
    return np.asarray(vertices[ConvexHull(vertices).vertices])


def _model(solids: Sequence[tuple[Piece, ...]], walls: Sequence[Piece], scale: float) -> Any:
    """Return the MuJoCo model of a floor, walls and free solids, multiplied by ``scale``.

    Only pieces collide with pieces and walls, and only hulls collide with the floor: a hull touches
    a plane where its pieces do, at a tenth of the contacts.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations, spec.option.ls_iterations = 20, 10
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    geoms = [(floor, _FLOOR, _HULL)]
    for number, wall in enumerate(walls):
        hull = add_hull(spec, spec.worldbody, f"wall{number}", scale * wall)
        geoms.append((hull, _PIECES, _PIECES))
    names = {id(solid): f"kind{number}" for number, solid in enumerate(solids)}
    for solid in solids:
        body, name = spec.worldbody.add_body(), names[id(solid)]
        body.add_freejoint()
        hull = add_hull(spec, body, name, scale * _hull(solid))
        hull.mass = 0.0
        geoms.append((hull, _HULL, _FLOOR))
        for index, piece in enumerate(solid):
            geom = add_hull(spec, body, f"{name}_{index}", scale * piece)
            geoms.append((geom, _PIECES, _PIECES))
    for geom, group, others in geoms:
        geom.contype, geom.conaffinity = group, others
        geom.friction, geom.solref = _FRICTION, [2 * _STEP, 1.0]
    return spec.compile()
