"""Bodies: surfaces that a scene can contain, their convex hulls and stable faces, and distractors.

To add a distractor shape, yield it from ``_solids`` or ``_profiles``. To add a part that a network
must not confuse with a target, pass it to the factory as a negative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Annotated, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from manifold3d import CrossSection, Manifold
from numpy.random import Generator
from scipy.spatial import ConvexHull, QhullError

from dopepp.core.errors import UserError
from dopepp.core.validation import Checked, Pair, Share, Span
from dopepp.geometry.rotation import Vector
from dopepp.parts.convex import Piece, convex_pieces, hull_faces
from dopepp.parts.mesh import Vertices
from dopepp.parts.part import Mesh, Part
from dopepp.virtual.scene import Triple, triple
from dopepp.virtual.surface import Surface, make_surface

WALL: Final = 0.03  # Thickness of a bin's walls, divided by the side length of its interior


@dataclass(frozen=True, eq=False)
class Body:
    """A surface that can be posed."""

    surface: Surface
    part: Part | None = None  # The part, if the network must detect it; None for a distractor
    source: Body | None = None  # Original of a stretched body, None for other bodies
    stretch: Triple = (1.0, 1.0, 1.0)  # Factors along the x, y and z axes of the source

    @cached_property
    def hull(self) -> Hull:
        """Convex hull; for a stretched body, the stretched hull of its source."""
        if self.source is not None:
            return self.source.hull.scaled(np.array(self.stretch))
        return make_hull(self.surface)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Convex pieces for physics, object frame, metres; of a distractor, only its hull."""
        if self.part is None:
            return (self.hull.vertices,)
        return convex_pieces(self.part)

    def stretched(self, scale: Vector) -> Body:
        """Return a distractor stretched along the object's x, y and z by positive factors."""
        stretch = triple(scale)
        return Body(self.surface.scaled(np.array(stretch)), source=self, stretch=stretch)


def make_body(part: Part, *, is_target: bool) -> Body:
    """Return a part's body; ``is_target`` says whether the network must detect the part.

    Raises:
        UserError: The part has no mesh.
    """
    if part.mesh is None:
        allowed = "parts that were read from a mesh file or built in"
        fix = "pass the part's mesh file, because the checkpoint contains no mesh"
        raise UserError(f"part {part.name} without a mesh", allowed, fix)
    return Body(make_surface(part.mesh), part if is_target else None)


@dataclass(frozen=True, eq=False)
class Hull:
    """A body's convex hull and centre of mass."""

    # Object frame, metres; in any orientation, the body's lowest point is one of them.
    vertices: Vertices
    triangles: Int[np.ndarray, "triangles 3"]
    facets: Int[np.ndarray, "triangles"]  # Index of the flat face to which each triangle belongs
    centre: Vector  # Centre of mass of the solid body, object frame, metres

    def scaled(self, scale: Vector) -> Hull:
        """Return the hull stretched along the object's x, y and z by positive factors."""
        # A linear map preserves the hull, its flat faces and the centre of mass.
        return replace(self, vertices=self.vertices * scale, centre=self.centre * scale)

    @cached_property
    def rests(self) -> tuple[Float[np.ndarray, "rests 3"], Float[np.ndarray, "rests"]]:
        """Outward normals of the stable faces, and the frequency with which the body rests on each.

        A face is stable if the centre of mass is above the face. The frequency is the face's solid
        angle from the centre: the share of directions in which a body that does not bounce lands.
        """
        corners = self.vertices[self.triangles] - self.centre
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        normals /= np.maximum(areas, 1e-300)[:, None]
        supported = _foot_inside(corners, normals) & (areas > 0)
        number = int(self.facets.max()) + 1
        # Bitwise equal sums on every run: bincount adds in order.
        shares = np.bincount(self.facets, _solid_angles(corners), number) / (4 * np.pi)
        stable = np.bincount(self.facets, supported, number) > 0
        largest = np.zeros(number, np.int64)
        order = np.argsort(areas, kind="stable")
        largest[self.facets[order]] = order  # the last and largest value remains
        chosen = np.flatnonzero(stable & (shares > 0.002))  # rarer faces are omitted
        if not len(chosen):
            # A ball of thousands of faces rests on each face rarely.
            chosen = np.flatnonzero(stable)
        shares = shares[chosen]
        if not shares.any():
            shares = np.ones(len(chosen))  # a flat sheet, whose centre lies in both of its faces
        return normals[largest[chosen]], shares / shares.sum()


def make_hull(surface: Surface) -> Hull:
    """Return a surface's convex hull and centre of mass; takes milliseconds per part."""
    used = surface.vertices[np.unique(surface.faces)]
    try:
        hull = ConvexHull(used)
    except QhullError:
        # A flat or straight mesh has no volume; "QJ" moves its points slightly to get a hull.
        hull = ConvexHull(used, qhull_options="QJ")
    triangles = hull_faces(hull)
    closed = surface.vertices[surface.faces] if surface.closed else hull.points[triangles]
    kept, index = np.unique(triangles, return_inverse=True)
    return Hull(
        vertices=np.asarray(used[kept], np.float64),
        triangles=index.reshape(-1, 3),
        facets=_facets(hull),
        centre=_centre_of_mass(closed),
    )


def _facets(hull: ConvexHull) -> Int[np.ndarray, "triangles"]:
    """Return each triangle's flat face: neighbours with normals within 0.05° share an index."""
    normals = hull.equations[:, :3]
    cosine = np.cos(np.radians(0.05))
    numbers = np.full(len(normals), -1)
    for seed in range(len(normals)):
        if numbers[seed] >= 0:
            continue
        numbers[seed], front = seed, [seed]
        while front:
            for neighbour in hull.neighbors[front.pop()]:
                if numbers[neighbour] < 0 and normals[neighbour] @ normals[seed] >= cosine:
                    numbers[neighbour] = seed
                    front.append(int(neighbour))
    return np.asarray(np.unique(numbers, return_inverse=True)[1])


def _centre_of_mass(corners: Float[np.ndarray, "faces 3 3"]) -> Vector:
    """Return the centroid of the volume inside triangles, by signed tetrahedra."""
    origin = corners.reshape(-1, 3).mean(axis=0)
    a, b, c = (corners - origin).swapaxes(0, 1)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    if not abs(volumes.sum()) > 1e-9 * np.abs(corners - origin).max() ** 3:
        return np.asarray(origin)  # almost no volume
    return np.asarray(origin + volumes @ (a + b + c) / (4 * volumes.sum()))


def _foot_inside(
    corners: Float[np.ndarray, "triangles 3 3"], normals: Float[np.ndarray, "triangles 3"]
) -> Bool[np.ndarray, "triangles"]:
    """Return whether the origin's projection onto a triangle's plane lies in the triangle."""
    foot = np.einsum("ij,ij->i", corners[:, 0], normals)[:, None, None] * normals[:, None]
    along = np.roll(corners, -1, axis=1) - corners
    side = np.einsum("ijk,ijk->ij", np.cross(along, foot - corners), normals[:, None])
    # With the tolerance, a foot on the edge between two triangles counts for at least one.
    return np.asarray((side >= -1e-9 * np.abs(along).max() ** 2).all(axis=1))


def _solid_angles(corners: Float[np.ndarray, "triangles 3 3"]) -> Float[np.ndarray, "triangles"]:
    """Return the solid angle of each triangle from the origin (van Oosterom and Strackee 1983)."""
    lengths = np.linalg.norm(corners, axis=2)
    (a, b, c), (la, lb, lc) = corners.swapaxes(0, 1), lengths.T
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dot = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a))]
    return np.asarray(
        2 * np.arctan2(volume, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb)
    )


@dataclass(frozen=True)
class Distractors(Checked):
    """Random objects around the targets.

    Attributes:
        number: Number per image; distractors that would hide too much of a target are omitted.
        image_share: Diameter of a distractor shape in the image, image widths.
        depth: Depth of floating distractors, in depths of the first target; unused on a table.
        lookalike_share: Probability that a distractor is a negative part, if negatives exist.
        lookalike_scale: Size of a negative, divided by its real size.
    """

    number: Annotated[tuple[int, int], Span(0, 100, "a count")] = (0, 2)
    image_share: Annotated[Pair, Span(1e-3, 10.0, "image widths")] = (0.12, 0.5)
    depth: Annotated[Pair, Span(0.01, 100.0, "depths of the first target")] = (0.6, 1.6)
    lookalike_share: Share = 0.3
    lookalike_scale: Annotated[Pair, Span(0.01, 100.0, "factor")] = (0.7, 1.3)

    def draw(self, rng: Generator, width_at_depth: float, negatives: Sequence[Body]) -> Body:
        """Sample a distractor for a depth at which the image spans ``width_at_depth`` metres."""
        if rng.random() < self.lookalike_share and negatives:
            negative = negatives[int(rng.integers(len(negatives)))]
            return negative.stretched(np.full(3, rng.uniform(*self.lookalike_scale)))
        shapes = distractor_shapes()
        radius = 0.5 * rng.uniform(*self.image_share) * width_at_depth
        shape = shapes[int(rng.integers(len(shapes)))]
        # Different factors along the axes make every distractor look different.
        return shape.stretched(radius * rng.uniform(0.5, 1.0, 3))


@cache
def distractor_shapes() -> tuple[Body, ...]:
    """Return the distractor shapes, each centred, with a bounding sphere of radius 1 m."""
    return tuple(Body(_unit_surface(solid)) for solid in _solids())


def _solids() -> Iterator[Manifold]:
    """Yield distractor shapes of arbitrary size and position."""
    yield Manifold.cube((1.0, 0.7, 0.5))
    yield Manifold.cube((1.0, 0.9, 0.15))
    yield Manifold.cylinder(1.0, 0.35, circular_segments=48)
    yield Manifold.cylinder(0.15, 0.6, circular_segments=48)
    yield Manifold.cylinder(1.0, 0.5, 0.2, circular_segments=48)
    yield Manifold.sphere(0.5, 32)
    for profile, thickness in _profiles():
        yield profile.extrude(thickness)


def _profiles() -> Iterator[tuple[CrossSection, float]]:
    """Yield profiles and thicknesses of plates with holes and other workshop parts."""

    def box(width: float, height: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
        return CrossSection.square((width, height), center=True).translate((x, y))

    def disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
        return CrossSection.circle(radius, 32).translate((x, y))

    yield box(1.0, 0.6) - disc(0.1, -0.35, 0.15) - disc(0.1, 0.35, -0.15), 0.08
    yield box(1.0, 0.5) - disc(0.16) - box(0.2, 0.06, 0.35) - disc(0.05, -0.4, 0.15), 0.06
    yield disc(0.5) - disc(0.3), 0.2
    yield disc(0.5) - disc(0.12) - disc(0.08, 0.3) - disc(0.08, -0.15, 0.26), 0.1
    yield CrossSection.circle(0.5, 6) - disc(0.28), 0.4
    yield box(1.0, 0.2, 0.0, -0.4) + box(0.2, 1.0, -0.4), 0.5
    yield box(1.0, 1.0) - box(0.7, 0.85, 0.0, 0.15), 0.4
    yield box(1.0, 0.25) + box(0.25, 1.0), 0.15


def _unit_surface(solid: Manifold) -> Surface:
    """Return the surface of a solid, centred and scaled to a bounding sphere of radius 1."""
    mesh = _mesh_of(solid)
    vertices = mesh.vertices - (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    vertices /= np.linalg.norm(vertices, axis=1).max()
    return make_surface(replace(mesh, vertices=vertices))


def _mesh_of(solid: Manifold) -> Mesh:
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
    return Mesh(vertices, np.asarray(mesh.tri_verts, np.int32))


@cache
def bin_walls() -> Body:
    """Return a bin without a floor: inner width, depth and height 1 m, origin on the ground."""
    outer = CrossSection.square((1 + 2 * WALL,) * 2, center=True)
    solid = (outer - CrossSection.square((1.0, 1.0), center=True)).extrude(1.0)
    return Body(make_surface(_mesh_of(solid)))


def bin_pieces() -> list[Piece]:
    """Return the four walls of :func:`bin_walls` as convex pieces."""
    near, far = 0.5, 0.5 + WALL
    ends = [((near, far), (-far, far)), ((-far, -near), (-far, far))]
    ends += [((-near, near), (near, far)), ((-near, near), (-far, -near))]
    return [np.array(list(product(x, y, (0.0, 1.0)))) for x, y in ends]
