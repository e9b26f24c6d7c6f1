import logging
from dataclasses import replace

import pytest

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import pivconnector, servoholder, with_meshes


def without_mesh(name, mesh_hash=""):
    return replace(servoholder(), name=name, mesh=None, mesh_hash=mesh_hash)


def test_a_given_mesh_is_used_and_compared(caplog):
    mesh_hash = servoholder().mesh_hash
    parts = [servoholder(), without_mesh("other", mesh_hash)]
    with caplog.at_level(logging.WARNING):
        meshed = with_meshes(parts, ["other=servoholder"])
    assert [part.name for part in meshed] == ["servoholder", "other"]
    assert all(part.mesh is not None for part in meshed)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        with_meshes([without_mesh("bracket", mesh_hash)], ["pivconnector"])
    assert "the checkpoint was not trained on this mesh" in caplog.text


def test_the_checkpoints_mesh_is_used_unless_another_is_given():
    part = replace(servoholder(), name="bracket")
    assert with_meshes([part])[0].mesh is part.mesh
    assert with_meshes([part], ["pivconnector"])[0].mesh is pivconnector().mesh


def test_missing_or_unknown_meshes():
    with pytest.raises(UserError, match=r"no mesh of bracket.*--part bracket=FILE"):
        with_meshes([without_mesh("bracket")])
    with pytest.raises(UserError, match="not in the checkpoint"):
        with_meshes([servoholder(), pivconnector()], ["wrong=servoholder"])
