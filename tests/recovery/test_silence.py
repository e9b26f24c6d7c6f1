import numpy as np
import pytest
import torch

from dopepp.recovery import Reason, explain
from dopepp.recovery.silence import explained, furthest, summary


def reason(kind, best, name="plate"):
    return Reason(name, kind, best, f"{kind} {best}")


def test_the_best_candidate_of_each_object_tells():
    reasons = [
        reason("pose", 0.9), reason("score", 0.1), reason("score", 0.2), reason("centroid", 0.99),
        reason("refined", 0.1, "box"), reason("empty", 0.0, "disc"),
    ]  # fmt: skip
    assert [str(one) for one in furthest(reasons)] == [
        "disc: empty 0.0", "plate: score 0.2", "box: refined 0.1",
    ]  # fmt: skip
    line = "box: refined 0.1; plate: score 0.2 (the best of 4); disc: empty 0.0"
    assert explained(reasons) == line
    assert explained([]) == ""


def test_many_silent_images_in_one_line():
    silent = [*(reason("score", best) for best in (0.1, 0.21, 0.05)), reason("empty", 0.001)]
    assert summary(silent, 300) == (
        "4 of 300 images silent: 1 with empty maps (best belief 0.001), "
        "3 below the threshold (best score 0.21)"
    )


@pytest.fixture
def scene(make_scene, box, pose):
    return make_scene(box).place(0, pose(np.random.default_rng(10)))


@pytest.mark.parametrize(
    ("factor", "options", "kind", "text"),
    [
        (0.0, {}, "empty", "no belief above 0"),
        (0.01, {}, "empty", "no belief above 0.0"),
        (0.04, {}, "centroid", "best belief of a centroid 0.0"),
        (float("nan"), {}, "empty", "no belief above 0"),
        (1.0, {"min_score": 1.0}, "score", "below 1"),
    ],
)
def test_what_ends_the_way_is_told_with_how_far_it_got(scene, factor, options, kind, text):
    belief, field = scene.maps()
    (one,) = explain(factor * belief, field, scene.cuboids, scene.K, names=["box"], **options)
    assert (one.object, one.kind) == ("box", kind)
    assert text in one.text
    if factor == factor:
        assert one.best == pytest.approx(factor, rel=0.25)


def test_a_part_of_two_cells_is_too_small(make_scene, box):
    from dopepp.geometry.camera import make_transform

    far = make_transform(np.eye(3), np.array([0.0, 0.0, 15.0]))
    scene = make_scene(box).place(0, far)
    belief, field = scene.maps()
    (one,) = explain(belief, field, scene.cuboids, scene.K, names=["box"], min_score=1.0)
    assert one.kind == "small"
    assert "px across, where a cell of the maps has 8" in one.text
    assert torch.isfinite(belief).all()
