"""The factory: a pure function of (seed, epoch, index), in any process and order, without torch."""

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Mesh, make_part
from dopepp.virtual import PRESETS, Factory, render
from dopepp.virtual.body import Distractors
from dopepp.virtual.sensor import Sensors, capture

DIGEST = """
import sys
sys.path.insert(0, {folder!r})
from test_factory import digest, make_factory, small
factory = make_factory(preset=small({name!r}))
print([digest(factory.render(epoch, index)) for epoch, index in {items!r}])
"""


def make_factory(seed=7, preset=None):
    return Factory([servoholder(), pivconnector()], preset or PRESETS["quickstart"], seed)


def small(name):
    return PRESETS[name].resized(128, 96)


def digest(rendered):
    content = hashlib.sha256()
    for array in (
        rendered.image, rendered.depth, rendered.instances, rendered.visible_fractions,
        rendered.scene.K, *(item.T_cam_obj for item in rendered.scene.objects),
    ):  # fmt: skip
        content.update(np.ascontiguousarray(array).tobytes())
    return content.hexdigest()


@pytest.mark.parametrize(
    "name",
    ["table", *(pytest.param(name, marks=pytest.mark.slow) for name in ("quickstart", "bin"))],
)
def test_same_bytes_in_another_process_and_order(name):
    items = [(0, 0), (0, 1), (3, 1), (0, 12)]
    factory = make_factory(preset=small(name))
    expected = [digest(factory.render(*item)) for item in reversed(items)][::-1]
    script = DIGEST.format(folder=str(Path(__file__).parent), items=items, name=name)
    command = [sys.executable, "-c", script]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == str(expected)
    assert len(set(expected)) == len(items)


def test_the_sensor_processes_the_rendered_image():
    noisy = Sensors(noise_probability=1.0, blur_probability=1.0, jpeg_probability=1.0)
    factory = make_factory(preset=replace(PRESETS["quickstart"], sensors=noisy))
    ideal, taken = render(factory.scene(0, 3)), factory.render(0, 3)
    assert taken.scene.sensor.jpeg_quality is not None
    np.testing.assert_array_equal(taken.image, capture(ideal.image, taken.scene.sensor))
    np.testing.assert_array_equal(taken.depth, ideal.depth)
    np.testing.assert_array_equal(taken.instances, ideal.instances)
    assert np.abs(taken.image.astype(int) - ideal.image).mean() > 0.5


def lookalikes(factory, num_scenes=20):
    """Radii of the negatives that scenes show, and how many other distractors there are."""
    sizes = [float(np.linalg.norm(part.cuboid[:8], axis=1).max()) for part in factory.negatives]
    negative_faces = {len(p.mesh.faces) for p in factory.negatives if p.mesh is not None}
    others, radii = 0, []
    for index in range(num_scenes):
        scene = factory.scene(0, index)
        for item in scene.objects[len(scene.targets) :]:
            assert item.label == "distractor"
            with pytest.raises(ValueError, match="distractor"):
                scene.keypoints(len(scene.objects) - 1)
            if len(item.surface.faces) in negative_faces:
                radii.append(item.surface.radius / max(sizes))
            else:
                others += 1
    return radii, others


def with_distractors(**changes):
    return replace(PRESETS["ycb"], distractors=Distractors((3, 3), **changes))


def test_other_built_in_parts_are_among_the_distractors():
    factory = Factory([pivconnector()], with_distractors(lookalike_share=0.5), 0)
    assert [part.name for part in factory.negatives] == ["servoholder"]
    radii, others = lookalikes(factory)
    assert 0.3 < len(radii) / (len(radii) + others) < 0.7
    # The farthest vertex lies a little inside of the cuboid's corner.
    assert 0.6 < min(radii) < max(radii) <= 1.3


def test_a_scene_does_not_depend_on_the_origin_of_the_mesh():
    part, offset = pivconnector(), np.array([0.5, -0.3, 0.2])
    mesh = replace(part.mesh, vertices=part.mesh.vertices + offset)
    parts = part, make_part(part.name, mesh)
    factories = [Factory([it], with_distractors(lookalike_share=0.0), 0) for it in parts]
    for index in range(3):
        expected, moved = (factory.scene(0, index).objects for factory in factories)
        assert len(expected) == len(moved) > 1
        for item, other in zip(expected, moved, strict=True):
            np.testing.assert_allclose(other.centre, item.centre, atol=1e-9)
            np.testing.assert_allclose(other.surface.radius, item.surface.radius, rtol=1e-9)


def test_without_lookalikes_or_other_parts_there_are_only_primitives():
    none = Factory([pivconnector()], with_distractors(lookalike_share=0.0), 0)
    assert lookalikes(none)[0] == []
    both = Factory([pivconnector(), servoholder()], with_distractors(lookalike_share=1.0), 0)
    assert both.negatives == ()
    assert lookalikes(both)[1] > 20


def test_given_negatives_come_first_and_once(box_part):
    factory = Factory([pivconnector()], with_distractors(lookalike_share=1.0), 0,
                      negatives=[box_part, servoholder()])  # fmt: skip
    assert [part.name for part in factory.negatives] == ["box", "servoholder"]
    assert lookalikes(factory)[1] == 0
    # A renamed built-in part is no negative.
    renamed = Factory([replace(servoholder(), name="mine")], PRESETS["quickstart"], 0)
    assert [part.name for part in renamed.negatives] == ["pivconnector"]


def test_seed_epoch_and_index_all_matter():
    factories, places = [make_factory(0), make_factory(1)], [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert len({digest(factory.render(*place)) for factory in factories for place in places}) == 8


BOX = make_part("box", Mesh(np.eye(3), np.array([(0, 1, 2)], np.int32)))
THING = replace(BOX, name="thing", mesh=None, mesh_hash="")


@pytest.mark.parametrize(
    ("parts", "seed", "negatives", "message"),
    [
        ([], 0, [], "at least one part"),
        ([BOX, BOX], 0, [], "each with its own name"),
        ([THING], 0, [], "part thing without a mesh"),
        ([BOX], -1, [], "seed -1"),
        ([pivconnector()], 0, [pivconnector()], "negative pivconnector, which is one of the tar"),
        ([BOX], 0, [replace(BOX, name="other")], "negative other, which is one of the targets box"),
        ([BOX], 0, [replace(servoholder(), name="box")], "negative box, which"),
        ([pivconnector()], 0, [THING], "part thing without a mesh"),
    ],
)
def test_wrong_factories_are_refused(parts, seed, negatives, message):
    with pytest.raises(UserError, match=message):
        Factory(parts, PRESETS["quickstart"], seed, negatives=negatives)
