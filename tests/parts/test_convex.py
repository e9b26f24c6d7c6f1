from dataclasses import replace

import numpy as np
import trimesh

from dopepp.parts import convex
from dopepp.parts.catalogue import load_part, servoholder
from dopepp.parts.convex import convex_pieces


def test_cached_pieces_belong_to_triangles_and_settings(tmp_path, monkeypatch):
    path = tmp_path / "block.stl"
    trimesh.creation.box((30, 20, 10)).export(path)
    part = load_part(path, "mm")
    larger = replace(part.mesh, vertices=part.mesh.vertices * 1.01)
    other = replace(part, mesh=larger)
    monkeypatch.setattr(convex, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(convex, "require", lambda *_: None)
    decomposed = []

    def decompose(mesh):
        decomposed.append(mesh)
        return (mesh.vertices,)

    monkeypatch.setattr(convex, "_decompose", decompose)
    assert other.mesh_hash == part.mesh_hash
    for shown in (part, other, part):
        (piece,) = convex_pieces(shown)
        np.testing.assert_allclose(piece, shown.mesh.vertices, atol=1e-8)
    assert decomposed == [part.mesh, larger]
    monkeypatch.setattr(convex, "CONCAVITY", 0.1)
    convex_pieces(part)
    assert len(decomposed) == 3
    convex_pieces(servoholder())  # in the package
    assert len(decomposed) == 3
