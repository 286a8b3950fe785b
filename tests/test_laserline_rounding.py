"""What a JPEG's rounding does to a line, foretold from the file: error bars of upright lines, where no row tells."""

import cv2
import numpy as np
import pytest
from synthetic_lines import GREEN, RED

from scanmap.laserline import LaserLineParams, find_laser_line, rounding_of
from scanmap.laserline.pooling import moved
from scanmap.laserline.rounding import Mixture, best_mixture, hidden_px, shared_px
from scanmap.laserline.sight import Conversion, channel_of, sight_of

ALONE = LaserLineParams()
ROWS, COLUMNS = 240, 288
SAMPLING = {"444": (1, 1), "422": (2, 1), "420": (2, 2)}  # columns and rows that share a sample of colour


def encoded(pixels, quality, sampling="422"):
    factor = getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{sampling}")
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
    return cv2.imencode(".jpg", pixels, how)[1].tobytes()


def opened(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def drawn(rng, column, peak, sigma, noise, colour=RED, tone=False):
    """A line at `column` (H,) of height `peak` (H,) or one for all, in grey levels after a camera's tone curve."""
    bell = np.exp(-0.5 * ((np.arange(COLUMNS) - column[:, None]) / sigma) ** 2)[..., None]
    height = np.broadcast_to(peak, len(column))[:, None, None]
    if tone:
        top = (height / 255.0 + 0.02 ** (1 / 2.2)) ** 2.2 - 0.02
        light = 255.0 * (top * bell * np.array(colour) + 0.02) ** (1 / 2.2)
    else:
        light = 12.0 + height * bell * np.array(colour)
    return np.clip(np.rint(light + noise * rng.standard_normal(light.shape)), 0, 255).astype(np.uint8)


def random_frame(rng, lean):
    """A picture's bytes and its columns: any quality, colour resolution, height, width, noise and laser."""
    column = rng.uniform(130.0, 146.0) + lean * (np.arange(ROWS) - ROWS / 2)
    peak, noise = np.exp(rng.uniform(np.log(30.0), np.log(230.0))), np.exp(rng.uniform(0.0, np.log(6.0)))
    colour, tone = (RED, GREEN)[rng.integers(2)], bool(rng.integers(2))
    pixels = drawn(rng, column, peak, rng.uniform(1.0, 4.0), noise, colour, tone)
    return encoded(pixels, int(rng.integers(75, 96)), str(rng.choice(list(SAMPLING)))), column


@pytest.mark.parametrize("sampling", SAMPLING)
def test_the_steps_are_those_of_the_standard(sampling: str) -> None:
    """Quality 50 is the tables of ITU-T T.81, annex K, as they stand there."""
    rounding = rounding_of(encoded(np.zeros((32, 32, 3), np.uint8), 50, sampling))
    assert rounding.brightness == (16, 11, 10, 16, 24, 40, 51, 61)
    assert rounding.colour == ((17, 18, 24, 47, 99, 99, 99, 99),) * 2
    assert (rounding.columns, rounding.rows) == SAMPLING[sampling]
    assert rounding_of(encoded(np.zeros((32, 32), np.uint8), 50)).colour is None


def test_a_damaged_header_is_no_rounding_but_no_error() -> None:
    data, rng = encoded(np.zeros((32, 32, 3), np.uint8), 85), np.random.default_rng(0)
    assert rounding_of(data[:100]) is None
    for _ in range(400):
        damaged = bytearray(data[: rng.integers(len(data))])
        for at in rng.integers(2, 600, 4):
            damaged[at : at + 1] = bytes(rng.integers(0, 256, 1, np.uint8))
        rounding = rounding_of(bytes(damaged))
        if rounding is not None:
            assert np.isfinite(shared_px(rounding, Mixture(2, 0.5), 1.0, np.ones(1), np.full(1, 50.0))).all()


def test_what_is_not_compressed_is_rounded_to_whole_levels_only() -> None:
    exact = rounding_of(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    width, height = np.full(1, 2.0), np.full(1, 64.0)
    without_noise = np.hypot(*shared_px(exact, Mixture(-1), 0.0, width, height))
    # The bound's own formula; the first harmonics of a rounding error have nine tenths of its variance.
    assert without_noise == pytest.approx(1.062 * np.sqrt(2.0 / 12.0) / 64.0, rel=0.08)
    assert np.hypot(*shared_px(exact, Mixture(-1), 0.5, width, height)) < 0.15 * without_noise


@pytest.mark.parametrize(
    ("quality", "sampling", "colour"), [(60, "444", None), (75, "420", RED), (85, "422", RED), (85, "422", GREEN)]
)
def test_the_error_that_all_rows_share_is_foretold(quality: int, sampling: str, colour) -> None:
    """Upright lines at many places: their means are off by what the file says, and by what is left of their noise."""
    shared = []
    for seed in range(64):
        rng = np.random.default_rng(seed)
        column, sigma, noise = np.full(ROWS, rng.uniform(130.0, 146.0)), rng.uniform(1.2, 2.8), 1.5
        pixels = drawn(rng, column, 70.0, sigma, noise, colour or (1.0,))
        data = encoded(pixels if colour else pixels[..., 0], quality, sampling)
        image, rounding = opened(data), rounding_of(data)
        off = find_laser_line(image, ALONE, rounding=rounding).column_px - column
        how, channel = Conversion("auto", 16, 0.0), channel_of(image, None, "auto")
        mixture = sight_of(image, None, how, ROWS, channel, [rounding]).mixtures[0]
        foretold = np.hypot(*shared_px(rounding, mixture, noise, np.full(1, sigma), np.full(1, 70.0)))[0]
        # Colour's samples may be 16 rows high.
        shared.append(np.nanmean(off) / np.hypot(foretold, np.nanstd(off) / np.sqrt(ROWS / 16)))
    assert 0.8 < np.sqrt(np.mean(np.square(shared))) < 1.2


def test_sigma_is_honest_whatever_the_file_and_however_the_line_leans() -> None:
    squares = {(lean, rows): [] for lean in (0.0, 0.004, 0.02, 0.2) for rows in (0, 9)}
    for (lean, rows), some in squares.items():
        for seed in range(60):
            data, column = random_frame(np.random.default_rng([seed, int(1000 * lean)]), lean)
            line = find_laser_line(opened(data), LaserLineParams(pool_rows=rows), rounding=rounding_of(data))
            some.append(np.nanmean(np.square((line.column_px - column) / line.sigma_px)))
    z = {how: np.sqrt(np.mean(some)) for how, some in squares.items()}
    assert min(z.values()) > 0.85 and max(z.values()) < 1.15, z  # 60 frames tell it to a twentieth
    assert 0.93 < np.sqrt(np.mean(np.square(list(z.values())))) < 1.07, z


def test_bright_and_dim_parts_of_a_frame_have_their_own_error_bars() -> None:
    """After a tone curve a bright line is no Gaussian: that is no noise, and a dim part must not be made to pay."""
    parts = {35.0: [], 200.0: []}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        column, peak = 138.0 + 8.0 * rng.random() + 0.03 * np.arange(2 * ROWS), np.repeat(list(parts), ROWS)
        data = encoded(drawn(rng, column, peak, 1.8, 1.2, tone=True), 92)
        line = find_laser_line(opened(data), ALONE, rounding=rounding_of(data))
        z = (line.column_px - column) / line.sigma_px
        for height, some in parts.items():
            some.append(np.nanmean(z[peak == height][10:-10] ** 2))
    for some in parts.values():
        assert 0.8 < np.sqrt(np.mean(some)) < 1.2


def test_a_leaning_line_shows_what_an_upright_one_hides() -> None:
    """All but what is rounded to nothing, which comes and goes in waves of several columns."""
    rounding, parts = (
        rounding_of(encoded(np.zeros((32, 32), np.uint8), 85)),
        (np.zeros(100, np.intp), np.full(100, 100)),
    )
    shared = np.tile([[3.0], [4.0]], 100)
    upright, steady, leaning, slanted = (
        hidden_px(rounding, shared, moved(lean * np.arange(100.0)[None], parts, np.full(1, 10))[0])
        for lean in (0.0, 0.01, 0.05, 0.3)
    )
    assert upright == pytest.approx(5.0)
    assert ((steady > 4.2) & (steady < 5.0)).all()
    assert leaning == pytest.approx(4.0, rel=0.02)
    assert slanted == pytest.approx(0.0, abs=1e-6)


def test_the_mixture_is_brightness_where_colour_is_coarse_and_noise_small() -> None:
    coarse, fine = (rounding_of(encoded(np.zeros((32, 32, 3), np.uint8), *how)) for how in ((75, "420"), (97, "444")))
    quiet, noisy = (0.5, 0.5, 0.5), (6.0, 6.0, 8.5)
    assert best_mixture(coarse, 2, quiet).share < best_mixture(coarse, 2, noisy).share < 0.66
    assert best_mixture(fine, 2, noisy).share >= 0.85
