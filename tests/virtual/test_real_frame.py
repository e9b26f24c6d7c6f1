"""Rendering YCB models at a real frame's ground truth reproduces that frame's masks and depth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

from dopepp.geometry.camera import make_transform
from dopepp.parts.mesh.read import ycb_part
from dopepp.virtual import Scene, SceneObject, make_surface, render
from dopepp.virtual.scene import Material

CLASSES = {2: "003_cracker_box", 4: "005_tomato_soup_can", 5: "006_mustard_bottle"}


@pytest.fixture(scope="module")
def frame(ycb_root):
    stem = ycb_root / "data" / "0050" / "000003"
    meta = loadmat(f"{stem}-meta.mat")
    return {
        "label": cv2.imread(f"{stem}-label.png", cv2.IMREAD_UNCHANGED),
        "depth": cv2.imread(f"{stem}-depth.png", cv2.IMREAD_UNCHANGED)
        / meta["factor_depth"].item(),
        "colour": cv2.cvtColor(cv2.imread(f"{stem}-color.png"), cv2.COLOR_BGR2RGB),
        "K": meta["intrinsic_matrix"].astype(np.float64),
        "poses": meta["poses"].astype(np.float64),
        "classes": meta["cls_indexes"].ravel(),
    }


@pytest.fixture(scope="module")
def rendered(ycb_root, frame, quick_sky):
    objects = []
    for class_index, name in CLASSES.items():
        part = ycb_part(ycb_root, name)
        pose = frame["poses"][..., frame["classes"].tolist().index(class_index)]
        T = make_transform(pose[:, :3], pose[:, 3])
        white = Material((1.0, 1.0, 1.0), 0.8)
        objects.append(SceneObject(make_surface(part.mesh), T, white, part))
    return render(Scene(frame["K"], np.zeros_like(frame["colour"]), tuple(objects)))


@pytest.mark.parametrize(("index", "class_index"), list(enumerate(CLASSES)))
def test_mask_and_depth(rendered, frame, index, class_index):
    mask, real = rendered.instances == index, frame["label"] == class_index
    assert (mask & real).sum() / (mask | real).sum() > 0.85
    known = mask & real & (frame["depth"] > 0)
    assert np.median(np.abs(rendered.depth - frame["depth"])[known]) < 0.01


def test_occlusion_order(rendered):
    # The bottle stands before the can and the box.
    assert rendered.visible_fractions[2] > 0.99
    assert (rendered.visible_fractions[:2] < 0.9).all()


@pytest.mark.parametrize("axis", [0, 1])
def test_texture_is_upright(ycb_root, rendered, frame, axis):
    scene = rendered.scene
    part = scene.objects[0].part
    uv = part.mesh.uv.copy()
    uv[:, axis] = 1 - uv[:, axis]
    flipped = replace(scene.objects[0], surface=make_surface(replace(part.mesh, uv=uv)))
    wrong = render(replace(scene, objects=(flipped, *scene.objects[1:])))
    box = (rendered.instances == 0) & (frame["label"] == 2)

    def likeness(image):
        # Green tells the red box's print from its ground.
        return float(np.corrcoef(image[box][:, 1], frame["colour"][box][:, 1])[0, 1])

    assert likeness(rendered.image) > likeness(wrong.image) + 0.2
