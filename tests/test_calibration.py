"""The calibration file: read back bit for bit, short and full form, every fault named, and the camera's rays."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from scanmap.calibration import Calibration, Intrinsics, PixelAngleModel, RatioModel
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, rigid, rotation_x, rotation_y, rotation_z

EXAMPLE = """
[image]
width = 1600
height = 1200
[intrinsics]                     # pinhole, OpenCV convention, pixels
fx = 1265.4749
fy = 1265.4749
cx = 799.5
cy = 599.5
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]   # k1 k2 p1 p2 k3
[head]
T_head_camera = [[-0.43366, 0.0, 0.90108, 0.0], [-0.90108, 0.0, -0.43366, 0.08], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
laser_plane = [0.0, 1.0, 0.0, 0.0]       # n.x + d = 0 in the head frame, metres
[axis]
head_offset_m = [0.0, 0.0, 0.0]          # head origin seen from the axis
tilt_deg = [0.0, 0.0]                    # axis against the head's z, about x and y
"""  # noqa: E501
SHORT = """
[image]
width = 1600
height = 1200
[head]
baseline_m = 0.08
beta_deg = 25.7
alpha_deg = 32.3
"""
finite = st.floats(-1e3, 1e3)
angle = st.floats(-3.0, 3.0)
lens = st.tuples(
    st.floats(-0.3, 0.1), st.floats(-0.02, 0.1), st.floats(-0.002, 0.002), st.floats(-0.002, 0.002),
    st.floats(-0.02, 0.02),
)  # fmt: skip
free = st.dictionaries(
    st.text("abcdefgh_", min_size=1),
    st.one_of(finite, st.integers(-9, 9), st.text(), st.lists(finite), st.booleans()),
    max_size=3,
)


@st.composite
def calibrations(draw):
    width, height = draw(st.integers(8, 4000)), draw(st.integers(8, 4000))
    focal = st.floats(0.5 * width, 3.0 * width)
    intrinsics = Intrinsics(
        width, height, draw(focal), draw(focal), draw(st.floats(0, width)), draw(st.floats(0, height)), draw(lens)
    )
    R = rotation_z(draw(angle)) @ rotation_y(draw(angle)) @ rotation_x(draw(angle))
    normal = rotation_z(draw(angle)) @ rotation_y(draw(angle)) @ np.array([0.0, 1.0, 0.0])
    mount = HeadMount((draw(finite), draw(finite), draw(finite)), (draw(st.floats(-20, 20)), draw(st.floats(-20, 20))))
    ratio = RatioModel(draw(st.floats(5, 60)), draw(st.floats(-60, 60)), draw(st.floats(0.01, 1)), width)
    pixel_angle = PixelAngleModel(draw(st.floats(1e-3, 1)), draw(st.floats(-60, 60)), draw(st.floats(0.01, 1)))
    return Calibration(
        intrinsics, rigid(R, [draw(finite), draw(finite), draw(finite)]), np.append(normal, draw(finite)), mount,
        draw(st.sampled_from([None, ratio])), draw(st.sampled_from([None, pixel_angle])), draw(free), draw(free),
        draw(free),
    )  # fmt: skip


def assert_same(a, b):
    """Equal to the last bit."""
    assert a.intrinsics == b.intrinsics
    assert a.T_head_camera.tobytes() == b.T_head_camera.tobytes()
    assert a.laser_plane.tobytes() == b.laser_plane.tobytes()
    assert (a.mount, a.ratio, a.pixel_angle) == (b.mount, b.ratio, b.pixel_angle)
    assert (a.residuals, a.covariance, a.meta) == (b.residuals, b.covariance, b.meta)


@given(calibration=calibrations())
@settings(max_examples=100, deadline=None)
def test_a_file_gives_the_calibration_back_bit_for_bit(calibration):
    assert_same(Calibration.loads(calibration.dumps()), calibration)


def test_saved_and_loaded(tmp_path):
    path = tmp_path / "calibration.toml"
    head = Calibration.loads(EXAMPLE)
    head.save(path)
    assert_same(Calibration.load(path), head)


def test_numbers_of_the_solvers_are_written_as_plain_numbers():
    head = Calibration.loads(EXAMPLE)
    solved = Calibration(
        Intrinsics(1600, 1200, np.float64(1265.4749), np.float64(1265.4749), np.float64(799.5), 599.5),
        head.T_head_camera,
        head.laser_plane,
        residuals={"rms_px": np.float32(0.25), "rows": np.int64(7)},
        covariance={"head": np.eye(2)},
    )
    back = Calibration.loads(solved.dumps())
    assert back.intrinsics == head.intrinsics
    assert back.residuals == {"rms_px": 0.25, "rows": 7}
    assert back.covariance == {"head": [[1.0, 0.0], [0.0, 1.0]]}


def test_the_example_is_the_head_of_the_thesis():
    head = Calibration.loads(EXAMPLE)
    assert head.baseline_m == pytest.approx(0.08)
    assert np.degrees(head.beta) == pytest.approx(25.7, abs=2e-4)
    assert np.degrees(head.alpha) == pytest.approx(32.3, abs=1e-4)
    assert head.mount == HeadMount()


def test_the_short_form_is_the_full_form():
    short, full = Calibration.loads(SHORT), Calibration.loads(EXAMPLE)
    np.testing.assert_allclose(short.T_head_camera, full.T_head_camera, atol=5e-6)
    np.testing.assert_array_equal(short.laser_plane, full.laser_plane)
    assert short.intrinsics.fx == pytest.approx(full.intrinsics.fx, abs=5e-5)
    assert (short.intrinsics.cx, short.intrinsics.cy) == (799.5, 599.5)
    assert short.intrinsics.fx == short.intrinsics.fy
    # Written out, it is the full form, and says the same.
    assert "baseline_m" not in short.dumps()
    assert_same(Calibration.loads(short.dumps()), short)


def test_half_the_short_form_goes_with_intrinsics():
    text = EXAMPLE.replace("T_head_camera", "# T_head_camera").replace(
        "[axis]", "baseline_m = 0.2\nbeta_deg = 0\n[axis]"
    )
    head = Calibration.loads(text)
    assert head.baseline_m == 0.2
    assert head.beta == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("scale", [0.1, 3.0, -2.0])
def test_a_plane_of_any_length_and_sign_is_the_same_plane(scale):
    plane = scale * np.array([0.0, 1.0, 0.0, 0.01])
    head = Calibration.loads(EXAMPLE.replace("[0.0, 1.0, 0.0, 0.0]       #", f"{plane.tolist()} #"))
    assert np.linalg.norm(head.laser_plane[:3]) == pytest.approx(1.0)
    assert head.baseline_m == pytest.approx(0.09)
    assert np.degrees(head.beta) == pytest.approx(25.7, abs=2e-4)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("fx = 1265.4749", ""), ["intrinsics.fx: is missing"]),
        (("fx = 1265.4749", "fx = -3.0"), ["intrinsics.fx = -3.0", "greater than 0"]),
        (("fx = 1265.4749", 'fx = "wide"'), ["intrinsics.fx = 'wide'", "number"]),
        (("fx = 1265.4749", 'fx = "1265"'), ["intrinsics.fx = '1265'", "number"]),
        (("fx = 1265.4749", "fx = inf"), ["intrinsics.fx = inf", "finite"]),
        (("cx = 799.5", "cx = nan"), ["intrinsics.cx = nan", "finite"]),
        (("cx = 799.5", "cx = 799.5\nzoom = 2"), ["intrinsics.zoom", "valid: fx, fy, cx, cy, distortion"]),
        (("[axis]", "[axes]"), ["axes", "valid: image, intrinsics, head, axis"]),
        (("width = 1600", "width = 1600.5"), ["image.width = 1600.5", "integer"]),
        (("width = 1600", "width = 0"), ["image.width = 0", "greater than 0"]),
        (("= [0.0, 0.0, 0.0, 0.0, 0.0]", "= [0.1, 0.2, 0, 0, 0, 0.1]"), ["intrinsics.distortion", "at most 5"]),
        (("0.90108, 0.0], [", "0.95, 0.0], ["), ["head.T_head_camera", "not a rigid transform"]),
        (("0.0, 1.0]]", "0.0, 2.0]]"), ["head.T_head_camera", "not a rigid transform"]),
        (("[0.0, 1.0, 0.0, 0.0]       #", "[0, 0, 0, 1] #"), ["head.laser_plane", "no normal"]),
        (("[0.0, 1.0, 0.0, 0.0]       #", "[0, 1, 0] #"), ["head.laser_plane.3"]),
        (("[0.0, 0.0, 0.0]          #", "[0, inf, 0] #"), ["axis.head_offset_m.1 = inf", "finite"]),
        (("[axis]", "beta_deg = 3.0\n[axis]"), ["head", "keep one"]),
        (("[axis]", "alpha_deg = 30.0\n[axis]"), ["keep one"]),
        (("[axis]", "[pixel_angle]\nrpc_deg = 0\nro_deg = 1\nbaseline_m = 1\n[axis]"), ["pixel_angle.rpc_deg = 0"]),
        (("[image]", "[image"), ["not valid TOML"]),
    ],
)
def test_a_fault_is_told_with_its_path_the_value_and_what_is_allowed(change, told):
    assert change[0] in EXAMPLE
    with pytest.raises(CalibrationError) as error:
        Calibration.loads(EXAMPLE.replace(*change), source="head.toml")
    message = str(error.value)
    assert message.startswith("head.toml")
    assert "\n" not in message
    for words in told:
        assert words in message


def test_every_fault_is_told_at_once_in_one_line():
    text = EXAMPLE
    for change in (
        ("width = 1600", "width = -1"), ("fx = 1265.4749", "fx = 0"), ("cy = 599.5", ""),
        ("0.90108, 0.0], [", "0.95, 0.0], ["), ("[0.0, 1.0, 0.0, 0.0]       #", "[0, 0, 0, 1] #"),
        ("tilt_deg = [0.0, 0.0]", "tilt_deg = [nan, 0.0]"), ("[axis]", "[axis]\nspin = 1"),
    ):  # fmt: skip
        text = text.replace(*change)
    with pytest.raises(CalibrationError) as error:
        Calibration.loads(text)
    message = str(error.value)
    assert "\n" not in message
    for where in (
        "image.width", "intrinsics.fx", "intrinsics.cy", "head.T_head_camera", "head.laser_plane", "axis.tilt_deg.0",
        "axis.spin",
    ):  # fmt: skip
        assert where in message


def test_missing_parts_of_the_short_form_are_named():
    with pytest.raises(
        CalibrationError, match="head: needs T_head_camera, or baseline_m and beta_deg; beta_deg missing"
    ):
        Calibration.loads(SHORT.replace("beta_deg", "# beta_deg"))
    with pytest.raises(CalibrationError, match=r"needs \[intrinsics\], or alpha_deg in \[head\]"):
        Calibration.loads(SHORT.replace("alpha_deg", "# alpha_deg"))


def test_an_unreadable_file_is_one_clear_error(tmp_path):
    with pytest.raises(CalibrationError, match=r"absent\.toml cannot be read"):
        Calibration.load(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match=r"binary\.toml cannot be read"):
        Calibration.load(tmp_path / "binary.toml")
    with pytest.raises(CalibrationError, match="cannot be written"):
        Calibration.loads(EXAMPLE).save(tmp_path / "no" / "folder.toml")


def test_images_of_another_size_are_refused():
    head = Calibration.loads(EXAMPLE)
    head.check_image(1600, 1200)
    with pytest.raises(CalibrationError, match=r"image is 640x480, the calibration is for 1600x1200.* --size 640x480"):
        head.check_image(640, 480)
    with pytest.raises(CalibrationError, match="turn them by 90 deg"):
        head.check_image(1200, 1600)
    for width, height in ((1200, 1600), (1280, 720)):
        with pytest.raises(CalibrationError, match=f"image is {width}x{height}") as caught:
            head.check_image(width, height)
        assert "scale" not in str(caught.value)  # which would refuse another aspect


def opens(intrinsics: Intrinsics, rays: np.ndarray) -> bool:
    """Whether a lens shows more and more of the world from its middle to some rays (N, 3)."""
    k1, k2, _, _, k3 = intrinsics.distortion
    r2 = np.linspace(0.0, float(np.nanmax(np.append(np.square(rays[:, :2]).sum(axis=1), 0.0))), 200)
    return bool((1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))).min() > 0.1)


@given(calibration=calibrations(), scale=st.sampled_from([0.25, 0.5, 2.0]), x=st.floats(0, 1), y=st.floats(0, 1))
@settings(max_examples=80, deadline=None)
def test_another_resolution_keeps_the_rays(calibration, scale, x, y):
    """A point of the picture, not a pixel's number, is what stays: pixel centres are at integers."""
    old = calibration.intrinsics
    scaled = calibration.scaled_to(round(old.width * scale), round(old.height * scale))
    new = scaled.intrinsics
    before = np.array([x * old.width - 0.5]), np.array([y * old.height - 0.5])
    after = np.array([x * new.width - 0.5]), np.array([y * new.height - 0.5])
    # Where a lens folds over, rounding decides whether a ray is found.
    assume(opens(old, np.concatenate([new.rays(*after), old.rays(*before)])))
    np.testing.assert_allclose(new.rays(*after), old.rays(*before), atol=1e-6)
    if calibration.pixel_angle is not None:
        a, b = calibration.pixel_angle, scaled.pixel_angle
        theta = a.rpc_deg * before[0] + a.ro_deg
        np.testing.assert_allclose(b.rpc_deg * after[0] + b.ro_deg, theta, atol=1e-8)
    if calibration.ratio is not None:
        assert scaled.ratio.width == new.width
    assert scaled.alpha == pytest.approx(calibration.alpha)
    np.testing.assert_array_equal(scaled.T_head_camera, calibration.T_head_camera)


@given(distortion=lens, seed=st.integers(0, 2**16))
@settings(max_examples=60, deadline=None)
def test_rays_and_pixels_are_inverse_and_the_lens_is_opencvs(distortion, seed):
    camera = Intrinsics(1600, 1200, 1265.0, 1270.0, 790.0, 610.0, distortion)
    # Rays no farther from the axis than 0.6: there none of these lenses folds.
    rng = np.random.default_rng(seed)
    away, turn = rng.uniform(0.0, 0.6, (4, 5)), rng.uniform(0.0, 2.0 * np.pi, (4, 5))
    rays = np.stack([away * np.cos(turn), away * np.sin(turn), np.ones((4, 5))], axis=-1)
    pixels = camera.project(rays * rng.uniform(0.1, 9, (4, 5, 1)))
    np.testing.assert_allclose(camera.rays(pixels[..., 0], pixels[..., 1]), rays, atol=1e-8)
    by_opencv = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion))[0]
    np.testing.assert_allclose(camera.project(rays).reshape(-1, 2), by_opencv[:, 0], atol=1e-7)


@given(distortion=lens, away=st.floats(0.0, 2.0), turn=st.floats(0.0, 2.0 * np.pi))
@settings(max_examples=200, deadline=None)
@example(distortion=(0.0, 0.09375, 0.0, 0.0, 0.01171875), away=1.2, turn=3.0)  # OpenCV's steps do not get there
@example(distortion=(0.0266, 0.0542, 0.0004, 0.0013, -0.0116), away=1.95, turn=1.0)  # and here get to beyond the fold
def test_wherever_a_lens_opens_its_rays_are_found(distortion, away, turn):
    camera = Intrinsics(1600, 1200, 1265.0, 1270.0, 790.0, 610.0, distortion)
    ray = np.array([[away * np.cos(turn), away * np.sin(turn), 1.0]])
    assume(opens(camera, ray))
    pixel = camera.project(ray)
    np.testing.assert_allclose(camera.rays(pixel[:, 0], pixel[:, 1]), ray, atol=1e-6)


def test_a_pixel_that_no_ray_reaches_has_none():
    """With k1 = -0.35 alone nothing comes out farther than 0.65 f from the centre: the corners are no picture."""
    camera = Intrinsics(1600, 1200, 1265.0, 1265.0, 799.5, 599.5, (-0.35, 0.0, 0.0, 0.0, 0.0))
    corner, middle = camera.rays(np.array([0.0, 800.0]), np.array([0.0, 600.0]))
    assert np.isnan(corner[:2]).all()
    assert np.isfinite(middle).all()


def test_nan_passes_and_what_is_behind_is_nowhere():
    for distortion in ((0.0,) * 5, (0.1, 0.0, 0.0, 0.0, 0.0)):
        camera = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5, distortion)
        rays = camera.rays(np.array([np.nan, 10.0]), np.array([5.0, 5.0]))
        assert np.isnan(rays[0, 0])
        assert np.isfinite(rays[1]).all()
        assert np.isnan(camera.project(np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0]]))).all()
