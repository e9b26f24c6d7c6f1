"""Write the two symmetric parts of ``docs/lab/symmetry.md`` as STL files in millimetres.

``python benchmarks/symmetric_parts.py FOLDER`` writes ``plate.stl``, 100 × 60 × 6 mm with two equal
holes (three 180° rotations), and ``can.stl``, a cylinder of 66 × 100 mm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import trimesh
from manifold3d import CrossSection, Manifold

SEGMENTS = 64


def plate() -> Manifold:
    """Return the plate, centred at the origin."""
    hole = Manifold.cylinder(10.0, 9.0, circular_segments=SEGMENTS, center=True)
    holes = hole.translate((28.0, 0.0, 0.0)) + hole.translate((-28.0, 0.0, 0.0))
    return Manifold.cube((100.0, 60.0, 6.0), center=True) - holes


def can() -> Manifold:
    """Return the can, centred at the origin, with its axis along z."""
    return CrossSection.circle(33.0, SEGMENTS).extrude(100.0).translate((0.0, 0.0, -50.0))


def main() -> None:
    """Write both files."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, solid in {"plate": plate(), "can": can()}.items():
        mesh = solid.to_mesh64()
        path = folder / f"{name}.stl"
        trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts).export(path)
        print(path)


if __name__ == "__main__":
    main()
