"""The twin's pictures: what a frame holds, noise as promised, the same for the same seed."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.rig import Camera
from scanmap.shot import decode_image, image_format
from scanmap.twin import LaserParams, LightParams, SensorParams, TwinCamera, TwinParams, build_scene
from scanmap.twin.sensor import STEPS, Sensor

CLEAN = SensorParams(noise=False, encoding="png", transfer="linear", glare=0.0)
BOX = TwinParams(room="box", scanner_position_m=(2.0, 1.5), laser=LaserParams(speckle=0.0), sensor=CLEAN)


def head(width: int = 800, height: int = 600) -> Calibration:
    file = CalibrationFile(
        image=ImageTable(width=width, height=height), head=HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3)
    )
    return file.build()


def shoot(
    params: TwinParams, calibration: Calibration, *states: tuple[float, bool], scene_of: TwinParams | None = None
) -> list[bytes]:
    queue = list(states)
    built = build_scene(scene_of or params, (scene_of or params).light)
    camera = TwinCamera(built, calibration, params, lambda: queue.pop(0))
    return [camera.grab().image for _ in states]


def pixels(data: bytes) -> NDArray[np.float64]:
    return decode_image(data).image.astype(np.float64)


def with_sensor(params: TwinParams, **changes: object) -> TwinParams:
    return params.model_copy(update={"sensor": params.sensor.model_copy(update=changes)})


def test_it_is_a_camera_that_sends_jpeg() -> None:
    clock: Callable[[], float] = iter([5.0, 6.5]).__next__
    params = TwinParams(room="box")
    camera: Camera = TwinCamera(build_scene(params, params.light), head(), params, lambda: (0.2, True), clock=clock)
    first, second = camera.grab(), camera.grab()
    assert (camera.width, camera.height) == (800, 600)
    assert image_format(first.image) == "jpeg" and decode_image(first.image).image.shape == (600, 800, 3)
    assert (first.time, second.time) == (5.0, 6.5)
    camera.close()
    camera.close()


def test_the_same_seed_gives_the_same_pictures_and_another_does_not() -> None:
    params = TwinParams(room="box")
    states = ((0.1, True), (0.1, False), (0.2, True))
    first, again = shoot(params, head(), *states), shoot(params, head(), *states)
    assert first == again
    other = shoot(params.model_copy(update={"seed": 2}), head(), *states)
    assert all(a != b for a, b in zip(first, other, strict=True))
    assert len(set(first)) == 3


@pytest.mark.parametrize("bearing", [0.0, 0.35])
def test_centre_of_the_decoded_line_is_true_to_a_fiftieth_of_a_pixel(bearing: float) -> None:
    params = BOX.model_copy(update={"light": LightParams(ambient=0.0), "laser": LaserParams(speckle=0.0)})
    red = pixels(shoot(params, head(1600, 1200), (bearing, True))[0])[:, :, 2]
    own = head(1600, 1200).intrinsics
    # The east wall is the plane x = 2; the laser's plane holds the axis: depth d along the head's x.
    depth = 2.0 / np.cos(bearing)
    tangent = np.tan(np.arctan(0.08 / depth) - np.radians(25.7))
    expected = own.cx + own.fx * tangent
    rows = slice(350, 850)
    assert 150 < red[600].max() < 255
    centre = red[rows] @ np.arange(1600) / red[rows].sum(axis=1)
    assert np.abs(centre - expected).max() < 0.02


def test_noise_belongs_to_the_view_whatever_was_shot_before() -> None:
    params = TwinParams(room="box")
    whole = shoot(params, head(320, 240), (0.1, True), (0.2, False), (0.2, True), (0.1, True))
    assert whole[0] != whole[3]
    assert shoot(params, head(320, 240), (0.2, True), (0.2, False), (0.1, True)) == [whole[2], whole[1], whole[0]]
    camera = TwinCamera(build_scene(params, params.light), head(320, 240), params, lambda: (0.1, True))
    assert [camera.grab().image, camera.grab().image] == [whole[0], whole[3]]
    camera.remember([0.3])
    assert camera.grab().image == whole[0]
    camera.remember([0.1])
    assert camera.grab().image not in whole


def test_laser_off_is_the_same_picture_without_the_line() -> None:
    on, off = (pixels(data) for data in shoot(BOX, head(), (0.3, True), (0.3, False)))
    difference = on - off
    touched = np.flatnonzero(difference.max(axis=(0, 2)) > 0)
    assert difference.min() == 0.0
    assert 4 < len(touched) < 60
    assert difference[300, :, 2].max() > 100


def test_a_head_that_did_not_move_sees_the_same_room() -> None:
    scene, calls = build_scene(BOX, BOX.light), []
    original = scene.radiance
    scene.radiance = lambda *a: calls.append(1) or original(*a)  # type: ignore[method-assign, func-returns-value]
    states = iter([(0.3, True), (0.3, False), (0.30001, False)])
    camera = TwinCamera(scene, head(), BOX, lambda: next(states))
    camera.grab()
    once = len(calls)
    camera.grab()
    assert len(calls) == once
    camera.grab()
    assert len(calls) == 2 * once


def test_coarse_casting_looks_like_casting_every_pixel() -> None:
    params = TwinParams(sensor=CLEAN.model_copy(update={"transfer": "srgb", "blur_px": 0.0}))
    scene, calibration = build_scene(params, params.light), head()
    shown = pixels(TwinCamera(scene, calibration, params, lambda: (1.2, False)).grab().image)
    u, v = np.meshgrid(np.arange(800), np.arange(600))
    own = calibration.intrinsics
    rays = np.stack([(u - own.cx) / own.fx, (v - own.cy) / own.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    T = calibration.mount.T_world_head(1.2) @ calibration.T_head_camera
    light = scene.radiance(T[:3, 3], (rays @ T[:3, :3].T).astype(np.float32)).reshape(600, 800, 3)
    coded = Sensor(params.sensor, 800, 600, np.random.default_rng(0)).code(light) / STEPS
    error = np.abs(shown[:, :, ::-1] - coded)
    assert np.mean(error) < 0.6
    assert np.mean(error > 8.0) < 0.004


@pytest.mark.parametrize("transfer", ["linear", "srgb"])
def test_noise_is_shot_noise_through_the_tone_curve_and_read_noise(transfer: str) -> None:
    params = with_sensor(BOX, noise=True, transfer=transfer, full_well_e=4000.0, read_noise_dn=1.5)
    params = params.model_copy(update={"light": LightParams(ambient=0.4)})
    a, b = (pixels(data) for data in shoot(params, head(), (0.3, False), (0.3, False)))
    patch = (slice(250, 350), slice(350, 450))
    measured = (a - b)[patch].std() / np.sqrt(2.0)
    level = a[patch].mean() / 255.0
    if transfer == "linear":
        light, slope = level, 255.0
    else:
        light = ((level + 0.055) / 1.055) ** 2.4
        slope = 255.0 * 1.055 / 2.4 * light ** (1 / 2.4 - 1)
    promised = np.sqrt(slope**2 * light / 4000.0 + 1.5**2 + 1 / 12)
    assert measured == pytest.approx(promised, rel=0.05)
    assert np.abs((a - b)[patch].mean()) < 0.1, "and it does not move the mean"


def test_noise_of_two_frames_is_independent() -> None:
    params = with_sensor(BOX, noise=True)
    a, b, c = (pixels(data)[100:500, 100:700] for data in shoot(params, head(), *[(0.3, False)] * 3))
    assert abs(np.corrcoef((a - c).ravel(), (b - c).ravel())[0, 1] - 0.5) < 0.02


def test_near_walls_saturate_and_stay_saturated_under_noise() -> None:
    near = BOX.model_copy(update={"scanner_position_m": (3.3, 1.5)})
    red = pixels(shoot(with_sensor(near, noise=True), head(), (0.0, True))[0])[:, :, 2]
    middle = red[290:310].argmax(axis=1)
    assert (red[290:310][np.arange(20), middle] == 255).all()
    assert (red[300] == 255).sum() > 3


def test_speckle_has_the_contrast_asked_for() -> None:
    dark = BOX.model_copy(update={"light": LightParams(ambient=0.0)})
    smooth, rough = (dark.model_copy(update={"laser": LaserParams(speckle=c, white_wall_peak=0.5)}) for c in (0.0, 0.2))
    plain, speckled = (pixels(shoot(p, head(), (0.0, True))[0])[200:400, :, 2] for p in (smooth, rough))
    bright = plain > 60
    ratio = speckled[bright] / plain[bright]
    assert ratio.std() == pytest.approx(0.2, abs=0.02)
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)


def test_glare_surrounds_the_line_with_its_share_of_the_light() -> None:
    def red(peak: float, glare: float) -> NDArray[np.float64]:
        laser = LaserParams(speckle=0.0, white_wall_peak=peak)
        dark = BOX.model_copy(update={"light": LightParams(ambient=0.0), "laser": laser})
        return pixels(shoot(with_sensor(dark, glare=glare, glare_px=8.0), head(), (0.0, True))[0])[250:350, :, 2]

    plain = red(0.6, 0.0)
    column = round(float(np.average(np.arange(800), weights=plain.sum(axis=0))))
    beside = [column - 12, column + 12]
    assert red(60.0, 0.0)[:, beside].max() == 0.0
    # The line is narrow against the glare: its light per row, spread over a Gaussian of 8 px.
    flux = 100.0 * plain.sum(axis=1).mean()
    expected = 0.02 * flux / (8.0 * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (12 / 8.0) ** 2)
    assert red(60.0, 0.02)[:, beside].mean() == pytest.approx(expected, rel=0.06)


def test_red_filter_leaves_red_of_room_and_line() -> None:
    green = BOX.model_copy(update={"laser": LaserParams(speckle=0.0, colour="green")})
    for laser_on, channels in ((False, [0, 1, 2]), (True, [1])):
        plain, red = (
            pixels(shoot(with_sensor(green, red_filter=f), head(), (0.3, laser_on))[0]) for f in (False, True)
        )
        ratio = red.max(axis=(0, 1)) / plain.max(axis=(0, 1))
        np.testing.assert_allclose(ratio[channels], np.array([0.05, 0.05, 0.92])[channels], atol=0.05)


@pytest.mark.parametrize("noise", [False, True])
def test_levels_are_rounded_not_cut_off(noise: bool) -> None:
    levels = np.array([0.0, 0.4, 0.6, 100.4, 100.6, 254.6, 300.0])
    silent = CLEAN.model_copy(update={"noise": noise, "full_well_e": 1e12, "read_noise_dn": 0.0})
    sensor = Sensor(silent, len(levels), 1, np.random.default_rng(0))
    coded = np.repeat(np.rint(levels * STEPS).astype(np.int16)[None, :, None], 3, axis=2)
    shown = decode_image(sensor.read_out(coded, sensor.noise_amplitude(coded), np.random.default_rng(0))).image[0, :, 0]
    assert shown.tolist() == [0, 0, 1, 100, 101, 255, 255]
    np.testing.assert_allclose(sensor.code(sensor.light(coded)), coded, atol=1)


def test_distortion_bends_the_room_as_opencv_does() -> None:
    """The undistorted picture of a distorting camera is the picture of one that does not."""
    straight = head()
    k = (-0.12, 0.05, 0.001, -0.001, 0.0)
    bent = CalibrationFile.model_validate(
        {
            "image": {"width": 800, "height": 600},
            "intrinsics": {"fx": 632.7, "fy": 632.7, "cx": 399.5, "cy": 299.5, "distortion": k},
            "head": {"T_head_camera": straight.T_head_camera.tolist()},
        }
    ).build()
    params = TwinParams(sensor=CLEAN.model_copy(update={"transfer": "srgb"}))
    first, second = (decode_image(shoot(params, c, (1.0, True))[0]).image for c in (straight, bent))
    K = straight.intrinsics.matrix
    undistorted = cv2.undistort(second, bent.intrinsics.matrix, np.array(k), None, K)
    inner = (slice(60, 540), slice(80, 720))
    grey = [cv2.GaussianBlur(image, (0, 0), 1.5)[inner].astype(np.float64) for image in (first, undistorted)]
    assert np.mean(np.abs(grey[0] - grey[1])) < 1.0


def test_params_say_what_is_wrong() -> None:
    for faulty in ({"sensor": {"jpeg_quality": 0}}, {"laser": {"colour": "pink"}}, {"lamp": 1}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(faulty))):
            TwinParams.model_validate(faulty)
