"""The page of ``dopepp serve`` in a browser."""

import json
import shutil
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.core.errors import UserError
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
FIND = "Find poses"

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the PATH")
if find_spec("gradio") is None:
    pytest.skip("without the extra web", allow_module_level=True)
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Folder with an image of the part, an empty image, a text file and a camera file."""
    folder = tmp_path_factory.mktemp("files")
    rendered = Factory([pivconnector()], PRESETS["quickstart"].reframed(640, 480), 2).render(0, 9)
    cv2.imwrite(str(folder / "part.png"), rendered.image[..., ::-1])
    cv2.imwrite(str(folder / "empty.png"), np.full((480, 640, 3), 90, np.uint8))
    (folder / "words.png").write_text("no image")
    np.savetxt(folder / "K.txt", rendered.scene.K)
    return folder


@pytest.fixture(scope="module")
def opened(piv_estimator):
    """The open page, and the external addresses that it has requested."""
    from dopepp.inference.page import serve_page

    elsewhere = []
    with serve_page(piv_estimator) as address, sync_api.sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        page.set_default_timeout(120_000)  # beside other work
        inside = (address, "data:", "blob:")
        page.on(
            "request",
            lambda request: request.url.startswith(inside) or elsewhere.append(request.url),
        )
        page.goto(address)
        page.get_by_role("button", name=FIND).wait_for()
        yield page, elsewhere
        browser.close()


@pytest.fixture
def page(opened):
    shown, elsewhere = opened
    yield shown
    assert not elsewhere


def upload(page, field, path):
    """Upload a file to an input field of the page."""
    area = page.locator(field)
    if area.get_by_label("Clear").count():
        area.get_by_label("Clear").click()
    area.locator("input[type=file]").set_input_files(path)
    area.get_by_text(path.name.split(".")[0]).first.wait_for()


def message_of(page):
    """Click on the button that finds poses; return the new message."""
    line = page.locator(".said")
    before = line.inner_text()
    page.get_by_role("button", name=FIND).click()
    sync_api.expect(line).not_to_have_text(before, timeout=60_000)
    return line.inner_text()


def test_image_yields_an_overlay_and_the_json_of_predict(page, files, tmp_path):
    upload(page, "#image", files / "part.png")
    page.get_by_label("camera file", exact=True).check()
    upload(page, "#camera", files / "K.txt")
    assert message_of(page) == "1 pose"
    shown = page.locator("#poses img")
    shown.wait_for()
    source = shown.get_attribute("src")
    pixels = np.frombuffer(page.request.get(source).body(), np.uint8)
    drawn, given = cv2.imdecode(pixels, 1), cv2.imread(str(files / "part.png"))
    changed = np.abs(drawn.astype(int) - given).max(axis=2) > 100
    assert 0.002 < changed.mean() < 0.2
    page.get_by_role("gridcell", name="pivconnector").wait_for(timeout=9000)
    with page.expect_download() as download:
        page.get_by_text("Download JSON").click()
    download.value.save_as(tmp_path / "poses.json")
    assert download.value.suggested_filename == "part.json"
    words = "pretrained/pivconnector", str(files / "part.png"), "--camera", str(files / "K.txt")
    done = CliRunner().invoke(app, ["predict", *words])
    predicted = [json.loads(line) | {"image": "part.png"} for line in done.stdout.splitlines()]
    assert len(predicted) == 1
    assert json.loads((tmp_path / "poses.json").read_text()) == predicted


@pytest.mark.parametrize(
    ("name", "view", "line"),
    [
        ("words.png", "60", "got image words.png: cannot identify the format"),
        ("part.png", "179", "got field of view=179; allowed: a number from 5 to 150 (degrees)"),
        ("empty.png", "60", "nothing found: pivconnector: its maps are empty"),
    ],
)
def test_errors_are_shown_in_a_sentence(page, files, name, view, line):
    upload(page, "#image", files / name)
    page.get_by_label("field of view", exact=True).check()
    page.get_by_label("Degrees across").fill(view)
    assert message_of(page).startswith(line)
    assert page.locator("#poses img").count() == (name == "empty.png")


def test_camera_of_another_image_size_is_reported(page, files):
    upload(page, "#image", files / "part.png")
    page.get_by_label("K", exact=True).check()
    for name in ("fx", "fy", "cx", "cy"):
        page.get_by_label(name, exact=True).fill("100")
    assert "likely of 201×201 (--K-size)" in message_of(page)


def test_used_port_is_reported(page, piv_estimator):
    from dopepp.inference.page import serve_page

    port = int(page.url.rstrip("/").rsplit(":", 1)[1])
    refused = pytest.raises(UserError, match=f"--port {port} already in use")
    with refused, serve_page(piv_estimator, port):
        raise AssertionError
