import json
import time

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.core.errors import UserError
from dopepp.data.formats.ndds.ndds_writer import camera_settings
from dopepp.geometry.camera import camera_matrix
from dopepp.geometry.camera_file import Camera, read_camera

K = camera_matrix(601.25, 602.5, 318.75, 242.5)
LENS = (-0.125, 0.0625, 0.001, -0.002, 0.03125)

ROS = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [601.25, 0.0, 318.75, 0.0, 602.5, 242.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.125, 0.0625, 1e-3, -2e-03, 0.03125]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [590, 0, 318, 0, 0, 598, 242, 0, 0, 0, 1, 0]
"""
ECHOED = """header:
  seq: 7
  stamp:
    secs: 1700000000
    nsecs: 250
  frame_id: "camera_color_optical_frame"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.125, 0.0625, 0.001, -0.002, 0.03125]
K: [601.25, 0.0, 318.75, 0.0, 602.5, 242.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [590.0, 0.0, 318.0, 0.0, 0.0, 598.0, 242.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi:
  x_offset: 0
  do_rectify: False
---
"""
ROS2 = ECHOED.translate(str.maketrans("DKRP", "dkrp"))


OPENCV_2 = """%YAML:1.0
---
calibration_time: "Thu 04 Jan 2018 15:01:25"
nframes: 13
image_Width: 640
image_Height: 480
flags: 6
fisheye_model: 0
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.0125e+02, 0., 3.1875e+02, 0., 6.025e+02, 2.425e+02, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.25e-01, 6.25e-02, 1.0e-03, -2.0e-03, 3.125e-02 ]
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<!-- a calibration -->
<image_size>
  640 480</image_size>
<cameraMatrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>601.25 0. 318.75 0. 602.5 242.5 0. 0. 1.</data></cameraMatrix>
<distCoeffs type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt>
  <data>-0.125 0.0625 1e-3 -2e-3 0.03125</data></distCoeffs>
</opencv_storage>
"""
BOP = """{"cx": 318.75, "cy": 242.5, "depth_scale": 0.1, "fx": 601.25, "fy": 602.5,
  "height": 480, "width": 640}"""
NDDS = """{"camera_settings": [{
  "name": "camera",
  "intrinsic_settings": {"fx": 601.25, "fy": 602.5, "cx": 318.75, "cy": 242.5, "s": 0},
  "captured_image_size": {"width": 640, "height": 480}
}]}"""
# COLMAP's (0.5, 0.5) is the centre of the top-left pixel.
COLMAP = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n1 {}\n"
ROWS = "601.25 0 318.75\n0 602.5 242.5\n0 0 1\n"
ANY = (640, 480)
FOUR = {"fx": 601.25, "fy": 602.5, "cx": 318.75, "cy": 242.5}


@pytest.mark.parametrize(
    ("text", "size", "lens"),
    [
        (ROS, ANY, LENS),
        (ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
         .replace("0.03125]", "0.03125, 0.5, 0.25, 0.125]"), ANY, (*LENS, 0.5, 0.25, 0.125)),
        (ECHOED, ANY, LENS),
        (ROS2, ANY, LENS),
        (OPENCV_2, ANY, LENS),
        (OPENCV_XML, ANY, LENS),
        (BOP, ANY, ()),
        (NDDS, ANY, ()),
        (json.dumps(camera_settings({"width": 640, "height": 480, "intrinsics": FOUR})), ANY, ()),
        (COLMAP.format("PINHOLE 640 480 601.25 602.5 319.25 243"), ANY, ()),
        (COLMAP.format("OPENCV 640 480 601.25 602.5 319.25 243 -0.125 0.0625 0.001 -0.002"), ANY,
         LENS[:4]),
        (ROWS, None, ()),
        ("# K\n[[601.25, 0.0, 318.75],\n [0, 602.5, 242.5], [0, 0, 1]]", None, ()),
        ("601.25 602.5 318.75 242.5", None, ()),
        ("\ufeff601.25, 602.5,\r\n 318.75, 242.5\r\n", None, ()),
        ("K: [[601.25, 0, 318.75], [0, 602.5, 242.5], [0, 0, 1]]\nD: [0, 0, 0, 0]", None, ()),
    ],
)  # fmt: skip
def test_every_format_has_the_same_content(text, size, lens, tmp_path):
    path = tmp_path / "camera.dat"
    path.write_text(text, encoding="utf-8")
    camera = read_camera(path)
    assert_array_equal(camera.K, K)
    assert (camera.size, camera.distortion, camera.source) == (size, lens, str(path))


@pytest.mark.parametrize(
    ("line", "lens"),
    [
        ("SIMPLE_PINHOLE 640 480 600 320 240", ()),
        ("SIMPLE_RADIAL 640 480 600 320 240 0.1", (0.1, 0, 0, 0)),
        ("RADIAL 640 480 600 320 240 0.1 -0.2", (0.1, -0.2, 0, 0)),
        ("FULL_OPENCV 640 480 600 600 320 240 1 2 3 4 5 6 7 8", (1, 2, 3, 4, 5, 6, 7, 8)),
    ],
)
def test_further_models_of_colmap(line, lens, tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(COLMAP.format(line))
    camera = read_camera(path)
    assert_array_equal(camera.K, camera_matrix(600, 600, 319.5, 239.5))
    assert camera.distortion == lens


NUMBERS = st.floats(-1e6, 1e6).map(lambda number: 0.0 if abs(number) < 1e-300 else number)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(["yaml", "yml", "xml", "json"]),
    st.tuples(st.floats(1e-3, 1e6), st.floats(1e-3, 1e6), NUMBERS, NUMBERS),
    st.one_of(st.lists(NUMBERS, min_size=n, max_size=n) for n in (0, 4, 5, 8, 12, 14)),
    st.booleans(),
)
def test_files_of_opencv_are_read_exactly(tmp_path, suffix, four, lens, is_column):
    path, matrix = tmp_path / f"camera.{suffix}", camera_matrix(*four)
    content = {
        "calibration_time": "Thu: 4 # of January", "image_width": 1280, "image_height": 720,
        "camera_matrix": matrix,
        "distortion_coefficients": np.array([lens]).T if is_column else np.array([lens]),
        "image_points": np.random.default_rng(0).normal(size=(3, 4, 2)),
    }  # fmt: skip
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        storage.write(name, value)
    storage.release()
    camera = read_camera(path)
    stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert_array_equal(camera.K, stored.getNode("camera_matrix").mat())
    assert_array_equal(camera.K, matrix)
    assert camera.size == (1280, 720)
    assert camera.distortion == (tuple(lens) if any(lens) else ())


BAD = {
    "empty": ("", "without any fields"),
    "text": ("The camera is on the left.", "without any fields"),
    "an image": ("\x89PNG\r\n", "'utf-8' codec"),
    "seven numbers": ("1 2 3 4 5 6 7", "7 numbers; allowed: nine"),
    "no pinhole": ("601 5 318 0 602 242 0 0 1", "3×3 pinhole"),
    "transposed": ("601 0 0 0 602 0 318 242 1", "3×3 pinhole"),
    "never calibrated": (ECHOED.replace("601.25", "0.0").replace("602.5", "0.0"), "calibrate the"),
    "fisheye in ROS": (ROS.replace("plumb_bob", "equidistant"), "undistort the images"),
    "fisheye in OpenCV": (OPENCV_2.replace("model: 0", "model: 1"), "fisheye_model=1"),
    "fisheye in COLMAP": (COLMAP.format("FOV 640 480 600 600 320 240 1"), "camera model FOV"),
    "two cameras": (COLMAP.format("PINHOLE 9 9 1 1 1 1\n2 PINHOLE 9 9 1 1 1 1"), "2 cameras ("),
    "too few": (COLMAP.format("PINHOLE 640 480 600 320 240"), "4 numbers after PINHOLE"),
    "stereo": ("M1: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nM2: [1]", "without camera_matrix (it has M1, M2)"),
    "two messages": (ECHOED + ECHOED, "single document"),
    "no height": (ROS.replace("image_height: 480", ""), "without image_height"),
    "no pixels": (ROS.replace("480", "0"), "image_height=0"),
    "half a pixel": (ROS.replace("480", "480.5"), "image_height=480.5"),
    "three coefficients": ("K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: [1, 2, 3]", "3 distortion"),
    "not as many": (ROS.replace("cols: 5", "cols: 4"), "distortion_coefficients of 1×4 with 5"),
    "not finite": (OPENCV_2.replace("6.0125e+02", ".Nan"), "Camera_Matrix.data='.Nan'"),
    "base64": (OPENCV_2.replace("[ -1.25e-01, 6.25e-02, 1.0e-03, -2.0e-03, 3.125e-02 ]",
                                '"$base64$ZAAAAA"'), "without base64"),
    "a word": (ROS.replace("318.75", "wide"), "camera_matrix.data='wide'"),
    "a truth": (BOP.replace("601.25", "true"), "fx=True"),
    "endless": (f"K: 0x{'f' * 9000}", "K=int"),
    "code": ("K: !!python/object/apply:os.system [id]", "the tag"),
    "deep in JSON": ('{"K": ' + "[" * 9000, "more than 64 levels"),
    "deep in XML": ("<opencv_storage>" + "<a>" * 9000 + "</a>" * 9000 + "</opencv_storage>",
                    "without camera_matrix"),
    "entities": ('<!DOCTYPE a [<!ENTITY b "b">]><opencv_storage><K>&b;</K></opencv_storage>',
                 "with DOCTYPE"),
    "an entity": ("<opencv_storage><K>&b;</K></opencv_storage>", "undefined entity"),
    "other XML": ("<svg/>", "<svg>"),
    "no XML": ("<opencv_storage><K>", "cannot be parsed"),
    "cameras of NDDS": ('{"camera_settings": [{}, {}]}', "camera_settings with 2 cameras"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_bad_file_gives_one_line(text, message, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_bytes(text.encode("latin-1"))  # an image's first byte is no UTF-8
    start = time.perf_counter()
    with pytest.raises(UserError) as caught:
        read_camera(path)
    assert time.perf_counter() - start < 2
    assert message in (line := str(caught.value))
    assert str(path) in line
    assert len(line) < 1000
    assert "\n" not in line


@pytest.mark.parametrize(
    ("name", "message"),
    [("missing", "No such file"), ("", "Is a directory"), ("large", "more than 0.25 MB"),
     ("nul\0", "null")],
)  # fmt: skip
def test_a_path_without_a_readable_file_is_refused(name, message, tmp_path):
    (tmp_path / "large").write_bytes(b"1 " * 600_000)
    with pytest.raises(UserError, match=message):
        read_camera(tmp_path / name)


SAMPLES = [ROS, ECHOED, OPENCV_2, OPENCV_XML, BOP, NDDS, COLMAP.format("PINHOLE 9 9 1 1 1 1"), ROWS]
MARKS = [b"[", b"{", b"-", b": ", b"&a ", b"!!", b"<", b"1e999", b"\n"]


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_changed_file_is_a_camera_or_refused(tmp_path, data):
    content = bytearray(data.draw(st.sampled_from(SAMPLES)).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        new = data.draw(st.one_of(st.binary(max_size=4), st.sampled_from(MARKS)))
        content[start : start + data.draw(st.integers(0, 6))] = new
    path = tmp_path / "camera.yaml"
    path.write_bytes(bytes(content))
    try:
        camera = read_camera(path)
    except UserError:
        return
    assert isinstance(camera, Camera)
    assert np.isfinite(camera.K).all()
    assert np.isfinite(camera.distortion).all()


def pixels(points, camera):
    lens = np.array(camera.distortion) if camera.distortion else None
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, lens)[0][:, 0]


POINTS = np.random.default_rng(0).uniform([-0.2, -0.15, 0.8], [0.2, 0.15, 1.2], (20, 3))
CAMERA = Camera((640, 480), K, LENS, "lens.yaml")
PLAIN = Camera(None, K, (), "--K")


@pytest.mark.parametrize("camera", [CAMERA, PLAIN])
def test_the_camera_of_an_image(camera):
    """Resizing or cropping an image moves projected points like the image's pixels."""
    whole = pixels(POINTS, camera)
    assert_array_equal(camera.for_picture((640, 480)).K, K)
    half = camera.for_picture((320, 240), K_size=(640, 480))
    assert (half.size, half.distortion) == ((320, 240), camera.distortion)
    assert_allclose(pixels(POINTS, half), (whole + 0.5) / 2 - 0.5, atol=1e-9)
    odd = camera.for_picture((213, 160), K_size=(640, 480))  # 213⅓: rounded to whole pixels
    assert_allclose(pixels(POINTS, odd), (whole + 0.5) * [213 / 640, 1 / 3] - 0.5, atol=1e-9)
    corner = camera.for_picture((100, 60), crop=(500, 400, 100, 60))
    assert_allclose(pixels(POINTS, corner), whole - [500, 400], atol=1e-9)


@pytest.mark.parametrize(
    ("camera", "size", "options", "message"),
    [
        (CAMERA, (320, 240), {}, "K is for 640×480, with an image of 320×240"),
        (CAMERA, (320, 240), {}, "--K-size 640 480 if the image was resized, --crop X Y 320 240"),
        (CAMERA, (1280, 960), {}, "fix: --K-size 640 480 if the image was resized$"),
        (CAMERA, (640, 360), {}, "fix: --crop X Y 640 360 if it was cropped"),
        (CAMERA, (480, 640), {}, "fix: rotate the image back"),
        (CAMERA, (1280, 720), {}, "fix: calibrate the camera at 1280×720"),
        (CAMERA, (1280, 720), {"K_size": (640, 480)}, "fix: calibrate the camera at 1280×720"),
        (CAMERA, (320, 240), {"K_size": (1280, 960)}, "--K-size 1280 960 with lens.yaml"),
        (PLAIN, (320, 240), {"K_size": (1280, 960)}, "1280×960 image of --K.*likely of 638×486"),
        (PLAIN, (320, 240), {"K_size": (0, 5)}, "--K-size 0 5; allowed: width and height above"),
        (PLAIN, (1280, 960), {}, "1280×960 image of --K: principal point at 25% of its width"),
        (CAMERA, (9, 9), {"K_size": (640, 480), "crop": (0, 0, 9, 9)}, "--K-size with --crop"),
        (CAMERA, (9, 9), {"crop": (0, 0, 10, 9)}, "--crop 0 0 10 9 with an image of 9×9"),
        (CAMERA, (9, 9), {"crop": (632, 0, 9, 9)}, "inside the calibrated image of 640×480"),
        (PLAIN, (9, 9), {"crop": (-1, 0, 9, 9)}, "--crop -1 0 9 9; allowed"),
        (Camera((64, 48), K, (), "x"), (64, 48), {}, "64×48 image of x: principal point at 499%"),
    ],
)
def test_the_k_of_another_image_is_refused(camera, size, options, message):
    with pytest.raises(UserError, match=message):
        camera.for_picture(size, **options)


def test_an_image_is_undistorted():
    """A dot at a point's distorted position moves to its pinhole position."""
    point = np.array([[0.45, -0.3, 1.0]])
    image = np.zeros((480, 640, 3), np.uint8)
    x, y = pixels(point, CAMERA)[0]
    cv2.circle(image, (round(x * 16), round(y * 16)), 4 * 16, (255, 255, 255), -1, shift=4)
    straight = CAMERA.undistorted(image)[..., 0].astype(float)
    rows, columns = np.mgrid[:480, :640]
    result = np.array([(straight * columns).sum(), (straight * rows).sum()]) / straight.sum()
    expected = pixels(point, PLAIN)[0]
    assert_allclose(result, expected, atol=0.3)
    assert np.linalg.norm(expected - (x, y)) > 5
    assert PLAIN.undistorted(image) is image
