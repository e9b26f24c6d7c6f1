"""Sizes of parts in the log, and the range that a network has learned."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from trimesh.exchange.stl import export_stl

from dopepp.core.errors import UserError
from dopepp.parts import load_part, servoholder
from dopepp.parts.mesh.read import body_extents
from dopepp.parts.size import LearnedRange, enclosing_range, part_in_words, size_in_words


def box(*extents, at=(0, 0, 0)):
    return trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at))


def inverted(mesh):
    mesh.invert()
    return mesh


BRACKET = box(62, 31, 40)


@pytest.mark.parametrize(
    ("meshes", "sizes"),
    [
        ([BRACKET], [(62, 31, 40)]),
        ([BRACKET, box(5, 5, 8, at=(100, 0, 0))], [(62, 31, 40), (5, 5, 8)]),
        ([box(1, 1, 1, at=(9, 0, 0)), box(2, 2, 2), box(3, 3, 3, at=(0, 9, 0))],
         [(3, 3, 3), (2, 2, 2), (1, 1, 1)]),
        ([BRACKET, inverted(box(10, 10, 10))], [(62, 31, 40)]),  # a cavity
        ([BRACKET, inverted(box(10, 10, 10)), box(4, 4, 4)], [(62, 31, 40), (4, 4, 4)]),
        ([BRACKET, box(31, 31, 31, at=(46.5, 0, 0))], [(62, 31, 40), (31, 31, 31)]),  # only touch
    ],
)  # fmt: skip
def test_bodies_are_counted_without_cavities(meshes, sizes):
    whole = trimesh.util.concatenate(meshes)
    result = body_extents(np.array(whole.vertices), np.array(whole.faces))
    np.testing.assert_allclose(result, sizes)


def test_an_open_surface_is_a_body():
    for cut in (BRACKET.faces[:-1], BRACKET.faces[:-1, ::-1]):
        assert len(body_extents(np.array(BRACKET.vertices), np.array(cut))) == 1


@pytest.fixture
def written(tmp_path):
    def write(*meshes):
        path = tmp_path / "bracket.stl"
        path.write_bytes(export_stl(trimesh.util.concatenate(meshes)))
        return str(path)

    return write


UNLIKELY = " (unlikely: most parts measure 0.01 – 2 m; is the unit right?)"


@pytest.mark.parametrize(
    ("mesh", "unit", "level", "words"),
    [
        (BRACKET, "mm", logging.INFO, "62 × 40 × 31 mm, read in mm"),
        (BRACKET, "cm", logging.INFO, "620 × 400 × 310 mm, read in cm"),
        (BRACKET, "inch", logging.WARNING, "1575 × 1016 × 787 mm, read in inch" + UNLIKELY),
        (box(0.6, 0.3, 0.3), "cm", logging.WARNING, "6.0 × 3.0 × 3.0 mm, read in cm" + UNLIKELY),
    ],
)
def test_the_log_states_size_and_unit(mesh, unit, level, words, written, caplog):
    with caplog.at_level(logging.INFO):
        load_part(written(mesh), unit)
    record = caplog.records[-1]
    assert (record.levelno, record.getMessage()) == (level, f"bracket: {words}")


def test_several_bodies_are_logged_once(written, caplog):
    with caplog.at_level(logging.INFO):
        load_part(written(BRACKET, box(5, 5, 8, at=(100, 0, 0))), "mm")
    lines = [record.getMessage() for record in caplog.records if "bodies" in record.getMessage()]
    sizes = "134 × 40 × 31 mm, read in mm; 2 bodies (62 × 40 × 31 mm, 8.0 × 5.0 × 5.0 mm)"
    assert lines == [f"bracket: {sizes}, which are rendered and detected as one part"]
    many = [box(1 + n / 9, 1, 1, at=(5 * n, 0, 0)) for n in range(5)]
    words = part_in_words(load_part(written(*many), "cm"))
    assert "; 5 bodies (the largest 14 × 10 × 10 mm), which" in words


def test_parts_without_a_file_have_no_unit():
    for part in (servoholder(), replace(servoholder(), mesh=None)):
        assert part_in_words(part) == "servoholder: 77 × 77 × 7.0 mm"
    assert size_in_words(np.array([0.0031, 0.2, 0.04])) == "200 × 40 × 3.1 mm"


@pytest.mark.parametrize(
    "record",
    [None, 4, [1, 2, 3], [9.0, 2.0, 0.1, 0.2], [1, 2, 0.2, 0.1], [1, 2, 0, 1], [1, "2", 0.1, 0.2],
     [1, math.nan, 0.1, 0.2], [1, 2, 0.1, math.inf], [True, 2, 0.1, 0.2]],
)  # fmt: skip
def test_an_invalid_range_is_refused(record):
    with pytest.raises(UserError):
        LearnedRange.parse(record)


def test_the_enclosing_range_contains_all_ranges():
    ranges = [LearnedRange(30, 40, 0.2, 0.3), LearnedRange(10, 35, 0.25, 0.9)]
    assert enclosing_range(ranges) == LearnedRange(10, 40, 0.2, 0.9)
