"""The commands ``dopepp doctor`` and ``dopepp serve``."""

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.core import errors
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

MODEL = "pretrained/pivconnector"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    rendered = Factory([pivconnector()], PRESETS["quickstart"], 411).render(0, 0)
    cv2.imwrite(str(folder / "good.png"), rendered.image[..., ::-1])
    cv2.imwrite(str(folder / "plain.png"), np.full((128, 128, 3), 90, np.uint8))
    np.savetxt(folder / "K.txt", rendered.scene.K)
    mesh = pivconnector().mesh
    trimesh.Trimesh(1000 * mesh.vertices, mesh.faces).export(folder / "piv.stl")
    return folder


def test_a_good_image_passes_all_checks(run, folder):
    words = (folder / "good.png", "--camera", folder / "K.txt", "--refine", "region")
    lines = run("doctor", "--model", MODEL, *words).stdout.splitlines()
    subjects = "part exposure sharpness camera size visibility elsewhere pose"
    assert [line.split(":")[0] for line in lines] == [f"ok {word}" for word in subjects.split()]
    assert "pivconnector measures 105 × 52 × 7.0 mm" in lines[0]
    assert "of its outline agrees" in lines[-1]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["plain.png", "--camera", "K.txt"], "!! visibility: pivconnector is not detected"),
        (["good.png", "--camera", "K.txt", "--at", "5,5"], "!! elsewhere: 1 of 1 detections"),
        (["good.png", "--camera", "K.txt", "--empty"], "!! elsewhere: 1 of 1 detections"),
        (["good.png", "--K", "220", "220", "127.5", "127.5"], "!! camera: K with fx=220"),
        (
            ["good.png", "--camera", "K.txt", "--part", "piv.stl", "--unit", "cm"],
            "!! part: pivconnector measures 105 × 52 × 7.0 mm, and its mesh 1050 × 520 × 70 mm, "
            "10 times that; fix: it was read in cm and is in mm: --unit mm",
        ),
    ],
)
def test_problems_come_first(run, folder, options, line, monkeypatch):
    monkeypatch.chdir(folder)
    done = run("doctor", "--model", MODEL, *options, code=1)
    assert done.stdout.startswith(line)
    assert "; fix: " in done.stdout.splitlines()[0]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["good.png", "--camera", "K.txt", "--at", "5"], "--at 5; allowed: u,v in pixels"),
        (["good.png", "--camera", "K.txt", "--at", "5,5", "--empty"], "--at together with --empty"),
        (["K.txt", "--camera", "K.txt"], "cannot identify the format"),
        (["good.png", "--camera", "K.txt", "--refine", "magic"], "--refine magic; allowed: region"),
        (["good.png", "--camera", "K.txt", "--distance", "2", "1"], "distances=(2.0, 1.0)"),
    ],
)
def test_wrong_input_is_one_line(refused, folder, options, line, monkeypatch):
    monkeypatch.chdir(folder)
    assert line in refused("doctor", "--model", MODEL, *options)


def test_a_page_that_cannot_be_served_is_one_line(refused, monkeypatch):
    assert "allowed: region;" in refused("serve", MODEL, "--refine", "depth")
    assert "--help" in refused("serve", MODEL, "--port", "0")
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    assert "pip install 'dopepp[web]'" in refused("serve", MODEL)
