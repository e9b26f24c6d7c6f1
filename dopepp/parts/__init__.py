"""Parts: 3D objects with mesh, unit, diameter and symmetries, and the two built-in parts."""

from dopepp.parts.catalogue import BUILTIN, load_part, pivconnector, servoholder
from dopepp.parts.mesh.read import read_mesh, ycb_part
from dopepp.parts.part import UNITS, Mesh, Part, make_part

__all__ = [
    "BUILTIN",
    "UNITS",
    "Mesh",
    "Part",
    "load_part",
    "make_part",
    "pivconnector",
    "read_mesh",
    "servoholder",
    "ycb_part",
]
