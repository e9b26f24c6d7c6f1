import numpy as np

from dopepp.training.callbacks.pictures import heat_picture


def test_a_belief_lies_over_the_pixels_its_cell_covers():
    image = np.full((90, 150, 3), 90, np.uint8)  # the maps cover its padding, too
    belief = np.zeros((12, 20), np.float32)
    belief[4, 11] = 1
    picture = heat_picture(image, belief).astype(int)
    assert picture.shape == image.shape
    hot = np.argwhere(np.abs(picture - 54).max(axis=2) > 100)  # 54 = the dimmed grey
    np.testing.assert_allclose(hot.mean(axis=0), [8 * 4 + 3.5, 8 * 11 + 3.5], atol=0.6)
    assert (picture[:24] == 54).all()


def test_beliefs_beyond_their_range_are_clipped():
    image = np.full((96, 160, 3), 90, np.uint8)
    one, seven = (heat_picture(image, np.full((12, 20), value, np.float32)) for value in (1, 7))
    np.testing.assert_array_equal(one, seven)
