"""Meshes and solids of miniature parts, shared by the tests of several folders."""

import numpy as np
import trimesh

from dopepp.parts.part import Mesh


def mesh_of(*solids, scale=1.0):
    """Return the mesh of one or more solids of trimesh; ``scale`` converts their unit to metres."""
    solid = trimesh.util.concatenate(solids) if len(solids) > 1 else solids[0]
    return Mesh(scale * np.asarray(solid.vertices), np.asarray(solid.faces, np.int32))


def solid_of(mesh):
    """Return the unprocessed solid of trimesh for a mesh."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
