"""The laser line in real photographs: of rooms, boards and plaster; with and without laser-off frames that match."""

import board_lines
import cv2
import numpy as np
import pytest
from line_pairs import PIECES, marked, pair

from scanmap.laserline import LaserLineParams, find_laser_line
from scanmap.laserline.channel import laser_channel
from scanmap.laserline.offmatch import shift_between

GAUSS = LaserLineParams()


def green_excess(image):
    """Column (H,) of each row's narrowest, greenest place, and whether it is clear and goes on along the rows."""
    b, g, r = np.moveaxis(image.astype(np.float32), 2, 0)
    excess = g - 0.5 * (b + r)
    narrow = cv2.blur(cv2.GaussianBlur(excess, (0, 0), 1.5) - cv2.GaussianBlur(excess, (0, 0), 9.0), (1, 3))
    column = narrow.argmax(axis=1)
    return column, (narrow.max(axis=1) > 7.0) & continues(column)


def continues(column):
    """Rows (H,) whose column most of the eight neighbouring rows continue."""
    near = [np.abs(np.roll(column, k) - column) <= 2.0 + 1.6 * abs(k) for k in (-4, -3, -2, -1, 1, 2, 3, 4)]
    return np.sum(near, axis=0) >= 6


def photographs_found(data, folder, pattern, step, reference, rows=slice(None)):
    """Fraction of the rows with a clear line in a photograph that the detector finds there, and elsewhere."""
    files = sorted((data / "real" / folder).glob(pattern))[::step]
    assert files
    clear = hit = astray = 0
    for file in files:
        image = cv2.imread(str(file))
        column, good = reference(image)
        line = find_laser_line(image, GAUSS)
        off, good = np.abs(line.column_px - column)[rows], good[rows]
        clear, hit, astray = clear + good.sum(), hit + (good & (off < 6)).sum(), astray + (good & (off >= 6)).sum()
    assert clear > 100 * len(files)
    return hit / clear, astray / clear


@pytest.mark.parametrize("number", sorted(PIECES))
def test_a_line_of_one_or_two_pixels_is_found_with_an_off_frame(data, number):
    """Sharpened and compressed pictures 240 columns wide; exposure changes, lamp, black and glossy things."""
    on, off = pair(data / "real" / "laser-range-finder" / "images", number)
    row = marked(number)
    column = find_laser_line(on, GAUSS, off).column_px
    near, carries = np.abs(column - row) <= 4.0, np.isfinite(row)
    assert near[carries].mean() >= 0.95
    assert np.mean(np.isfinite(column[carries]) & ~near[carries]) <= 0.005


def brightened(*factors):
    return lambda image: np.clip(np.rint(image * np.float32(factors)), 0, 255).astype(np.uint8)


def bent(exponent):
    table = np.clip(np.rint(255.0 * (np.arange(256) / 255.0) ** exponent), 0, 255).astype(np.uint8)
    return lambda image: table[image]


def shaken(down, right):
    matrix = np.array([[1.0, 0.0, right], [0.0, 1.0, down]], np.float32)
    return lambda image: cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


# What may happen between laser off and laser on, and what share of the rows is still found at least: over all pairs
# and in the worst. What the brighter one cuts at white is lost.
CHANGES = {
    "exposure 0.7": (brightened(0.7, 0.7, 0.7), 0.96, 0.9),
    "exposure 1.2": (brightened(1.2, 1.2, 1.2), 0.955, 0.85),
    "exposure 1.4": (brightened(1.4, 1.4, 1.4), 0.93, 0.68),
    "warmer": (brightened(0.8, 1.0, 1.2), 0.955, 0.85),
    "colder": (brightened(1.2, 1.0, 0.8), 0.96, 0.88),
    "gamma 0.8": (bent(0.8), 0.96, 0.88),
    "gamma 1.25": (bent(1.25), 0.95, 0.82),
    "half a pixel across": (shaken(0.0, 0.5), 0.96, 0.85),
    "2 px across": (shaken(0.0, 2.0), 0.965, 0.93),
    "2 px along": (shaken(-2.0, 0.0), 0.965, 0.93),
    "1 px askew": (shaken(1.0, -1.0), 0.965, 0.93),
}


@pytest.mark.parametrize("change", sorted(CHANGES))
def test_a_laser_off_frame_need_not_match(data, change):
    apply, least, least_in_one = CHANGES[change]
    found, astray = [], 0
    for number in sorted(PIECES):
        on, off = pair(data / "real" / "laser-range-finder" / "images", number)
        row = marked(number)
        column = find_laser_line(on, GAUSS, np.asarray(apply(off), np.uint8)).column_px
        near, carries = np.abs(column - row) <= 4.0, np.isfinite(row)
        found.append(near[carries].mean())
        astray += int(np.sum(np.isfinite(column[carries]) & ~near[carries]))
    assert np.mean(found) >= least
    assert min(found) >= least_in_one
    assert astray <= 10


@pytest.mark.parametrize(("down", "right"), [(0.0, 0.0), (-2.0, 0.0), (1.0, 2.0), (0.4, -1.3)])
def test_a_shift_between_two_photographs_is_measured(data, down, right):
    for number in (2, 6, 8):
        on, off = (picture[..., 1] for picture in pair(data / "real" / "laser-range-finder" / "images", number))
        back = shift_between(on, np.asarray(shaken(-down, -right)(off), np.uint8))
        # Sharpened pictures 240 columns wide; a shift by parts of a pixel blurs them.
        np.testing.assert_allclose(back, (down, right), atol=0.3 if right % 1.0 else 0.12)


def test_the_lasers_channel_is_told_on_a_white_board_in_a_bright_room(data):
    files = sorted((data / "real" / "srv-calib" / "laser").glob("*.jpg"))[::4]
    channels = [laser_channel(np.asarray(cv2.imread(str(file)), np.uint8)) for file in files]
    assert np.mean(np.array(channels) == 1) >= 0.96


def boards_found(data, numbers, params, change=None):
    """Share of the rows found where a board carries the line, and beside it; and of all rows found elsewhere."""
    folder = data / "real" / "srv-calib" / "laser"
    carry, found, astray = np.zeros(2), np.zeros(2), 0
    for number in numbers:
        image, columns = board_lines.picture(folder, number), board_lines.marked(number)
        on_board, beside = board_lines.carrying(image, columns)
        column = find_laser_line(image if change is None else change(image), params).column_px
        off = np.abs(column - columns)
        near = ((off <= 4.0) & np.stack([on_board, beside])).any(axis=0)
        for k, rows in enumerate((on_board, beside & ~on_board)):
            carry[k], found[k] = carry[k] + rows.sum(), found[k] + (rows & near).sum()
        astray += (np.isfinite(column) & ~(off <= 6.0).any(axis=0)).sum()
    return (*found / carry, astray / (480 * len(numbers)))


@pytest.mark.parametrize(("grey", "least", "most_astray"), [("auto", 0.968, 0.01), ("green", 0.968, 0.01)])
def test_a_line_on_white_boards_before_a_cabinet_full_of_things(data, grey, least, most_astray):
    on_board, beside, astray = boards_found(data, board_lines.NUMBERS[::4], LaserLineParams(grey=grey))
    assert on_board >= least
    assert beside >= 0.6
    assert astray <= most_astray


# What other cameras make of the same room: share of the rows found on the boards at least, and elsewhere at most.
CAMERAS = {
    "darker": (brightened(0.7, 0.7, 0.7), 0.93, 0.01),
    "warmer": (brightened(0.8, 1.0, 1.2), 0.95, 0.03),
    "colder": (brightened(1.2, 1.0, 0.8), 0.91, 0.06),
    "gamma 0.8": (bent(0.8), 0.965, 0.02),
    "gamma 1.25": (bent(1.25), 0.965, 0.03),
    "red laser": (lambda image: np.ascontiguousarray(image[..., [0, 2, 1]]), 0.965, 0.01),
    "blue laser": (lambda image: np.ascontiguousarray(image[..., [1, 0, 2]]), 0.93, 0.04),
}


@pytest.mark.parametrize("camera", sorted(CAMERAS))
def test_boards_seen_by_other_cameras(data, camera):
    change, least, most_astray = CAMERAS[camera]
    on_board, _, astray = boards_found(data, board_lines.NUMBERS[::6], GAUSS, change)
    assert on_board >= least
    assert astray <= most_astray


def test_columns_of_the_sensor_that_are_always_white_are_no_line(data):
    def with_faults(image):
        faulty = image.copy()
        faulty[:, [300, 501, 502]] = 255
        return faulty

    on_board, _, astray = boards_found(data, board_lines.NUMBERS[::6], GAUSS, with_faults)
    assert on_board >= 0.93
    assert astray <= 0.03


def test_a_picture_that_was_cut_short_has_the_line_where_it_has_rows(data):
    image = board_lines.picture(data / "real" / "srv-calib" / "laser", 45)
    # What decoders that do not refuse such pictures fill them up with.
    image[200:] = 128
    off = np.abs(find_laser_line(image, GAUSS).column_px - board_lines.marked(45)[0])
    assert np.mean(off[:200] <= 4.0) >= 0.97
    assert np.isnan(off[204:]).all()


def test_a_thin_line_on_white_plaster_in_a_bright_room(data):
    # The wall, above the table's edge.
    found, astray = photographs_found(data, "srv-calib/table", "*.jpg", 8, green_excess, slice(0, 240))
    assert found >= 0.97
    assert astray <= 0.005
