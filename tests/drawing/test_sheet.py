"""Contact sheets: every picture where it belongs."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dopepp.drawing.overlay import text_coverage
from dopepp.drawing.sheet import Tile, contact_sheet

RED, GREY = (200, 10, 10), (90, 90, 90)


def plain(colour: tuple[int, int, int], width: int = 40, height: int = 30) -> NDArray[np.uint8]:
    return np.full((height, width, 3), colour, np.uint8)


def test_tiles_stand_in_reading_order():
    colours = [(10 * i, 100, 50) for i in range(5)]
    sheet = contact_sheet([Tile(plain(c)) for c in colours], columns=2, tile_width=40)
    assert sheet.shape == (3 * 30 + 4 * 6, 2 * 40 + 3 * 6, 3)
    for i, colour in enumerate(colours):
        row, column = divmod(i, 2)
        top, left = 6 + 36 * row, 6 + 46 * column
        assert (sheet[top : top + 30, left : left + 40] == colour).all()
    assert (sheet[78:108, 52:92] == 255).all()  # the sixth place is empty


def test_tiles_of_any_size_get_one_width_and_keep_their_shape():
    tiles = [Tile(plain(RED, 10, 20)), Tile(plain(GREY, 400, 100))]
    sheet = contact_sheet(tiles, columns=5, tile_width=100)
    assert sheet.shape == (200 + 12, 2 * 100 + 18, 3)
    assert (sheet[6:206, 6:106] == RED).all()
    assert (sheet[6:31, 112:212] == GREY).all()
    assert (sheet[32:206, 112:212] == 255).all()


@pytest.mark.parametrize("caption", ["ADD 3.1 mm", "Δ = 4° · a very long caption " * 9, "$x"])
def test_a_caption_is_written_below_its_picture(caption):
    sheet = contact_sheet([Tile(plain(RED, 120, 90), caption)], tile_width=120)
    assert sheet.shape == (90 + 18 + 12, 132, 3)
    assert (sheet[6:96, 6:126] == RED).all()
    assert (sheet[96:114, 6:126] < 100).any()
    assert (sheet[114:] == 255).all()


@pytest.mark.parametrize("arguments", [([], 2, 10), ([Tile(plain(RED))], 0, 10)])
def test_an_empty_sheet_is_refused(arguments):
    with pytest.raises(ValueError, match="a sheet needs tiles, columns and a width"):
        contact_sheet(*arguments)


def test_text_fits_its_line_and_is_as_wide_as_its_letters():
    short, long = text_coverage("i", 20), text_coverage("iiiiiiiiii", 20)
    assert short.shape[0] == 20
    assert 3 * short.shape[1] < long.shape[1]
    letters = text_coverage("Ågjy|", 20)
    assert letters.max() > 0.9
    assert letters[0].max() < 0.1  # nothing is cut off above or below
    assert letters[-1].max() < 0.1
