import cv2
import numpy as np
import pytest
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import photo_size, read_image, read_photo, read_picture, read_rgb
from dopepp.parts.mesh.obj import read_texture


@pytest.fixture
def image():
    noise = np.random.default_rng(1).integers(0, 256, (40, 60, 3), np.uint8)
    return cv2.GaussianBlur(noise, (5, 5), 2)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_images_agree_with_pillow(tmp_path, image, suffix):
    path = tmp_path / f"image{suffix}"
    Image.fromarray(image).save(path)
    expected = np.asarray(Image.open(path).convert("RGB"))
    # Two JPEG decoders may round differently by a few levels.
    tolerance = 0 if suffix == ".png" else 4
    np.testing.assert_allclose(read_rgb(path).astype(int), expected.astype(int), atol=tolerance)


def test_alpha_depth_and_grey(tmp_path, image):
    rgba = np.dstack([image, image[..., 0]])
    Image.fromarray(rgba).save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(read_image(tmp_path / "rgba.png"), rgba)
    depth = np.arange(2400, dtype=np.uint16).reshape(40, 60) * 27
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    np.testing.assert_array_equal(read_image(tmp_path / "depth.png"), depth)
    with pytest.raises(UserError, match="uint16; allowed: 8 bits"):
        read_rgb(tmp_path / "depth.png")
    Image.fromarray(image[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "grey.png"), image[..., [0, 0, 0]])


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.95, 0.999])
def test_a_truncated_file_is_an_error(tmp_path, image, suffix, share):
    path = tmp_path / f"image{suffix}"
    Image.fromarray(image).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError, match=rf"image\{suffix}.*allowed: a complete PNG or JPEG"):
        read_image(path)


def test_damage_and_other_formats(tmp_path, image):
    path = tmp_path / "image.png"
    Image.fromarray(image).save(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(UserError, match="damaged at byte"):
        read_image(path)
    path.write_text("not an image")
    with pytest.raises(UserError, match="none of PNG, JPEG"):
        read_image(path)


def test_rare_kinds_of_pixels_agree_with_opencv(tmp_path, image):
    original, path = Image.fromarray(image), tmp_path / "image.png"
    for rare in (original.convert("P"), original.convert("1"), original.convert("LA")):
        rare.save(path)
        expected = cv2.imread(str(path), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(read_rgb(path), expected[..., ::-1])
    assert cv2.imwrite(str(path), image.astype(np.uint16) * 257)
    with pytest.raises(UserError, match=r"image\.png of 16-bit colours; allowed: 8 bits"):
        read_image(path)


def test_a_jpeg_may_have_data_after_its_end_marker(tmp_path, image):
    path = tmp_path / "image.jpg"
    Image.fromarray(image).save(path)
    expected = read_rgb(path)
    path.write_bytes(path.read_bytes() + b"maker notes" * 1000)
    np.testing.assert_array_equal(read_rgb(path), expected)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_of_a_photo_agrees_with_opencv(tmp_path, image, orientation):
    path, exif = tmp_path / "photo.jpg", Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(image).save(path, exif=exif, quality=95)
    expected = cv2.imread(str(path))[..., ::-1]
    assert read_photo(path).shape == expected.shape
    np.testing.assert_allclose(read_photo(path).astype(int), expected.astype(int), atol=4)
    for other in (tmp_path / f"photo{suffix}" for suffix in (".jpg", ".tiff", ".png", ".webp")):
        Image.fromarray(image).save(other, exif=exif)
        assert photo_size(other) == read_photo(other).shape[1::-1] == expected.shape[1::-1]
    np.testing.assert_array_equal(read_picture(path), read_photo(path))
    height, width = expected.shape[:2]
    assert read_picture(path, max(width, height) // 2).shape[:2] == (height // 2, width // 2)


def test_labelled_images_and_textures_keep_their_stored_pixels(tmp_path, image):
    path, exif = tmp_path / "image.png", Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(image).save(path, exif=exif)
    for read in (read_rgb, read_image, read_texture):
        np.testing.assert_array_equal(read(path), image)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_photos_of_8_and_16_bits(tmp_path, image, suffix, channels, kind):
    if (suffix, channels > 1, kind) == (".tiff", True, np.uint16):
        pytest.skip("Pillow reads no 16-bit colours from TIFF")
    wide = np.dstack([image, image[..., :1]])[..., :channels].astype(kind)
    if kind == np.uint16:
        wide = 256 * wide + 200  # 16 bits, whose upper eight are the original value
    path = tmp_path / f"photo{suffix}"
    cv2.imwrite(str(path), wide[..., [2, 1, 0, 3][:channels]] if channels > 2 else wide)
    expected = image if channels > 1 else image[..., [0, 0, 0]]
    for read in (read_photo, read_picture, read_texture):
        np.testing.assert_array_equal(read(path), expected)


def test_pictures_of_other_depths_are_refused(tmp_path):
    Image.fromarray(np.full((4, 6), 0.5, np.float32)).save(tmp_path / "float.tiff")
    with pytest.raises(ValueError, match="not of 8 or 16 bits"):
        read_picture(tmp_path / "float.tiff")


SAVE = "fix: save it as PNG, e.g. with ImageMagick: magick"


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("several.gif", f"{SAVE} several.gif image.png"),
        ("several.tiff", f"{SAVE} several.tiff image.png"),
        ("float.tiff", "of mode F"),
        ("raw.png", "-auto-level"),
        ("colours.png", "-auto-level"),
        ("text.png", "save it as PNG"),
        ("missing.png", "pass the path of an existing file"),
    ],
)
def test_errors_about_photos_contain_a_fix(tmp_path, image, name, fix):
    first, second = Image.fromarray(image), Image.fromarray(image[::-1])
    for several in ("several.gif", "several.tiff"):
        first.save(tmp_path / several, save_all=True, append_images=[second])
    Image.fromarray(image[..., 0].astype(np.float32)).save(tmp_path / "float.tiff")
    # 12 significant bits in 16: the upper eight bits are almost black.
    cv2.imwrite(str(tmp_path / "raw.png"), 16 * image[..., 0].astype(np.uint16))
    cv2.imwrite(str(tmp_path / "colours.png"), 16 * image.astype(np.uint16))
    (tmp_path / "text.png").write_text("no image")
    for read in (read_photo, photo_size)[
        : 1 + (name in ("several.gif", "text.png", "missing.png"))
    ]:
        with pytest.raises(UserError, match=f"{name}.*{fix}"):
            read(tmp_path / name)
