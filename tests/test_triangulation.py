"""The three range models: the thesis's numbers, the exact pinhole, laws of projection, sigma and the window."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.calibration import Calibration, CalibrationFile, Intrinsics, PixelAngleModel, RatioModel
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, inverse, rigid, rotation_x, rotation_y, rotation_z, transform
from scanmap.laserline import LaserLine, Reason
from scanmap.triangulation import (
    TriangulationParams,
    column_window,
    locate,
    pixel_angle_depth,
    pixel_angle_model_of,
    pixel_ratio,
    ratio_depth,
    ratio_model_of,
    triangulate,
)

ALG1 = RatioModel(alpha_deg=32.3, beta_deg=25.7, baseline_m=0.08, width=1600)
ALG2 = PixelAngleModel(rpc_deg=0.044, ro_deg=-8.768, baseline_m=0.08)
MODELS = ("plane", "ratio", "pixel_angle")
BROWN = (-0.12, 0.04, 0.001, -0.0015, -0.005)


def thesis_head(width=1600, height=1200, **parts):
    head = CalibrationFile.model_validate(
        {"image": {"width": 1600, "height": 1200}, "head": {"baseline_m": 0.08, "beta_deg": 25.7, "alpha_deg": 32.3}}
    ).build()
    head = head if (width, height) == (1600, 1200) else head.scaled_to(width, height)
    return replace(head, **parts)


def oblique_head(distortion=BROWN, seed=0):
    """A head with a distorted lens, a camera rolled and moved off the level, and a laser that shines askew."""
    rng = np.random.default_rng(seed)
    base = thesis_head(640, 480)
    a, b, c = rng.uniform(-0.06, 0.06, 3)
    T = base.T_head_camera @ rigid(rotation_z(a) @ rotation_y(b) @ rotation_x(c), [0.0, 0.0, 0.0])
    T[:3, 3] += rng.uniform(-0.01, 0.01, 3)
    normal = rotation_z(rng.uniform(-0.05, 0.05)) @ rotation_x(rng.uniform(-0.1, 0.1)) @ np.array([0.0, 1.0, 0.0])
    intrinsics = replace(base.intrinsics, distortion=distortion)
    return Calibration(intrinsics, T, np.append(normal, rng.uniform(-0.005, 0.005)), HeadMount((0.02, 0.01, 0.0)))


def line_at(column, rows, sigma=0.1):
    column = np.broadcast_to(np.asarray(column, float), (rows,)).copy()
    reason = np.where(np.isfinite(column), Reason.OK, Reason.WEAK).astype(np.uint8)
    one = np.where(np.isfinite(column), 1.0, np.nan)
    return LaserLine(column, 100.0 * one, 2.0 * one, sigma * one, reason)


def depth_at(column, calibration, model="plane", row=None):
    row = calibration.intrinsics.cy if row is None else row
    points, _, _ = locate(
        np.array([float(column)]), np.array([float(row)]), calibration, TriangulationParams(model=model)
    )
    return points[0, 0]


# --- the thesis


@pytest.mark.parametrize(
    ("column", "by_ratio", "by_angle"),
    [
        (530, 0.2986, 0.3082),
        (600, 0.2475, 0.2517),
        (698, 0.1997, 0.1986),
        (848, 0.1541, 0.1471),
        (1072, 0.1149, 0.1009),  # published 0.105: not what the published constants give
        (1264, 0.0943, 0.0750),  # published 0.079
        (1582, 0.0728, 0.0446),  # published "below limit" and 0.047
    ],
)
def test_the_table_of_the_thesis_recomputed(column, by_ratio, by_angle):
    assert round(float(ratio_depth(np.array(column), ALG1)), 4) == by_ratio
    assert round(float(pixel_angle_depth(np.array(column), ALG2)), 4) == by_angle


def test_the_published_table_is_ours_where_its_formula_gives_it(data):
    table = np.genfromtxt(data / "thesis_table.csv", delimiter=",", names=True)
    off = np.abs(ratio_depth(table["ppx"], ALG1) - table["published_alg1_m"])
    np.testing.assert_array_equal(off < 0.0025, [True] * 4 + [False] * 3)
    assert np.nanmax(np.abs(pixel_angle_depth(table["ppx"], ALG2) - table["published_alg2_m"])[:6]) < 0.001


def test_errata_of_the_thesis():
    tangents = np.tan(np.radians([32.3, 25.7, 32.0, 25.0]))
    # 0.0718, printed as 0.071 and beside 32 and 25, which give 0.0733.
    assert np.floor(1e3 * 0.08 / (tangents[0] + tangents[1])) == 71
    assert round(0.08 / (tangents[2] + tangents[3]), 4) == 0.0733
    assert round(tangents[0] + tangents[1], 4) == 1.1134  # equation 14 prints 1.114
    assert round(2.0 * tangents[0], 4) == 1.2643  # equation 15 prints 1.266
    assert round(0.08 / np.tan(np.radians(60.0)), 4) == 0.0462  # given as 0.047
    # p = 0 is the right border: nothing is nearer in Algorithm 1.
    assert ratio_depth(np.array(1600.0), ALG1) == pytest.approx(0.08 / (tangents[0] + tangents[1]))
    apart = np.abs(ratio_depth(np.array(1582.0), ALG1) - pixel_angle_depth(np.array(1582.0), ALG2))
    assert round(float(apart), 3) == 0.028  # "no more than 0.007 m"


def test_the_pixel_ratio_runs_from_one_to_zero():
    np.testing.assert_allclose(pixel_ratio(np.array([0.0, 400.0, 1600.0]), 1600), [1.0, 0.75, 0.0])


def test_algorithm_2_says_below_range_from_sixty_degrees_on():
    head = thesis_head(pixel_angle=ALG2)
    column = np.full(1200, np.nan)
    column[[0, 1, 2, 3]] = [1562.0, 1562.9, 1563.0, 1599.0]
    profile = triangulate(line_at(column, 1200), head, TriangulationParams(model="pixel_angle"))
    np.testing.assert_array_equal(profile.reason[:5], [Reason.OK, Reason.OK, *[Reason.BELOW_RANGE] * 2, Reason.WEAK])
    assert np.isnan(profile.points[2:4]).all()
    assert np.isnan(profile.range_m[2:4]).all()
    # theta of column 1562 is 59.96 deg
    assert profile.points[0, 0] == pytest.approx(0.08 / np.tan(np.radians(0.044 * 1562 - 8.768)))


@pytest.mark.parametrize(
    ("model", "parts", "infinity"),
    [
        ("plane", {}, 190.5),
        ("ratio", {}, 191.0),
        ("pixel_angle", {"pixel_angle": ALG2}, 199.3),
        ("pixel_angle", {"pixel_angle": PixelAngleModel(0.0439, -8.7683, 0.08)}, 199.7),
    ],
)
def test_infinity_lies_where_the_page_says(model, parts, infinity):
    """Farther than a kilometre on one side, nothing at all on the other."""
    head = thesis_head(**parts)
    low, high = 150.0, 250.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if np.isfinite(depth_at(middle, head, model)) else (middle, high)
    assert round(high, 1) == infinity
    assert depth_at(high + 1e-3, head, model) > 500.0
    params = TriangulationParams(model=model)
    reason = triangulate(line_at(np.r_[high - 5.0, high + 1.0, np.full(1198, np.nan)], 1200), head, params).reason
    np.testing.assert_array_equal(reason[:2], [Reason.BEYOND_RANGE] * 2)


@given(column=st.floats(195.0, 1599.0), alpha=st.floats(20, 45), beta=st.floats(0, 35))
@settings(max_examples=100, deadline=None)
def test_the_plane_model_on_the_middle_row_is_the_exact_pinhole(column, alpha, beta):
    """d = x / tan(beta + atan(((2 ppx + 1) / l - 1) tan alpha))."""
    head = CalibrationFile.model_validate(
        {"image": {"width": 1600, "height": 1200}, "head": {"baseline_m": 0.08, "beta_deg": beta, "alpha_deg": alpha}}
    ).build()
    theta = np.radians(beta) + np.arctan(((2 * column + 1) / 1600 - 1) * np.tan(np.radians(alpha)))
    if theta > 1e-3:
        assert depth_at(column, head) == pytest.approx(0.08 / np.tan(theta), rel=1e-9)
    else:
        assert not depth_at(column, head) < 79.0


def test_the_half_pixel_costs_4_mm_at_1_m_and_37_mm_at_3_m():
    head = thesis_head()
    for true, error_mm in ((1.0, 4), (3.0, 37)):
        column = 799.5 + head.intrinsics.fx * np.tan(np.arctan2(0.08, true) - head.beta)
        assert depth_at(column, head) == pytest.approx(true, abs=1e-12)
        assert round(1e3 * abs(depth_at(column + 0.5, head) - true)) == error_mm


@pytest.mark.parametrize("model", MODELS)
def test_the_height_of_a_row_follows_from_the_pinhole_ray(model):
    """z = -(v - cv) / f (d cos beta + x sin beta), in all three models."""
    head = thesis_head(ratio=ALG1, pixel_angle=ALG2)
    column = np.linspace(400.0, 1500.0, 1200)
    points = triangulate(line_at(column, 1200), head, TriangulationParams(model=model, range_min_m=0.0)).points
    tangent = -(np.arange(1200) - 599.5) / head.intrinsics.fy
    beta = np.radians(25.7)
    np.testing.assert_allclose(points[:, 2], tangent * (points[:, 0] * np.cos(beta) + 0.08 * np.sin(beta)), atol=1e-12)
    np.testing.assert_allclose(points[:, 1], 0.0, atol=1e-12)
    assert points[0, 2] > 0 > points[-1, 2]  # the upper row is up


def test_without_fitted_constants_the_models_take_the_head_for_their_own():
    head = thesis_head()
    own = ratio_model_of(head)
    np.testing.assert_allclose([own.alpha_deg, own.beta_deg, own.baseline_m, own.width], [32.3, 25.7, 0.08, 1600])
    assert ratio_model_of(replace(head, ratio=ALG1)) is ALG1
    assert pixel_angle_model_of(replace(head, pixel_angle=ALG2)) is ALG2
    straight = pixel_angle_model_of(head)
    column = np.arange(1600)
    theta = 25.7 + np.degrees(np.arctan((column - 799.5) / head.intrinsics.fx))
    usable = (theta > 0) & (theta < 60)
    off = straight.rpc_deg * column[usable] + straight.ro_deg - theta[usable]
    # Least squares: what is left has no mean and no slope.
    assert abs(off.mean()) < 1e-9
    assert abs(np.corrcoef(off, column[usable])[0, 1]) < 1e-9


def test_the_thesis_models_refuse_heads_they_do_not_hold_for():
    head = thesis_head()
    flat = replace(head, laser_plane=np.array([0.0, 1.0, 0.0, -0.08]))
    mirrored = replace(head, T_head_camera=rigid(rotation_z(np.radians(25.7)) @ head_forward(), [0.0, -0.08, 0.0]))
    outward = replace(head, T_head_camera=rigid(rotation_z(np.radians(75)) @ head_forward(), [0.0, 0.08, 0.0]))
    for model in ("ratio", "pixel_angle"):
        params = TriangulationParams(model=model)
        with pytest.raises(CalibrationError, match="no baseline"):
            triangulate(line_at(500.0, 1200), flat, params)
        with pytest.raises(CalibrationError, match="use model plane"):
            triangulate(line_at(500.0, 1200), mirrored, params)
    with pytest.raises(CalibrationError, match="no column of this head"):
        pixel_angle_model_of(outward)
    # The plane model takes the mirrored head: infinity lies on the right.
    assert depth_at(1599.0 - 600.0, mirrored) == pytest.approx(depth_at(600.0, head))


def head_forward():
    return np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


# --- laws


@given(seed=st.integers(0, 2**16), far=st.floats(0.2, 7.0), up=st.floats(-0.35, 0.35), model_seed=st.integers(0, 50))
@settings(max_examples=100, deadline=None)
def test_a_point_of_the_laser_plane_is_found_where_its_picture_is(seed, far, up, model_seed):
    """Project by the camera, triangulate, and the point is back: any lens, pose and laser plane."""
    distortion = tuple(np.random.default_rng(seed).uniform(-1, 1, 5) * [0.15, 0.05, 0.002, 0.002, 0.01])
    head = oblique_head(distortion, model_seed)
    normal, d = head.laser_plane[:3], head.laser_plane[3]
    point = np.array([far, 0.0, up * far])
    point -= (point @ normal + d) * normal
    pixel = head.intrinsics.project(transform(inverse(head.T_head_camera), point))
    found, _, below = locate(pixel[:1], pixel[1:], head, TriangulationParams())
    own = head.intrinsics
    if (pixel > -20).all() and (pixel < [own.width + 20, own.height + 20]).all():
        np.testing.assert_allclose(found[0], point, atol=1e-5 * far**2 + 1e-7)
    assert not below.any()


@given(column=st.floats(-50, 1700), row=st.integers(0, 479), seed=st.integers(0, 50))
@settings(max_examples=100, deadline=None)
def test_every_found_point_lies_in_the_laser_plane_before_the_camera(column, row, seed):
    head = oblique_head(seed=seed)
    points, slope, _ = locate(np.array([column]), np.array([float(row)]), head, TriangulationParams())
    if np.isfinite(points).all():
        assert abs(points[0] @ head.laser_plane[:3] + head.laser_plane[3]) < 1e-9 * (1 + np.linalg.norm(points))
        assert transform(inverse(head.T_head_camera), points[0])[2] > 0
        assert slope[0] > 0


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("distance", [0.3, 1.0, 3.0])
def test_sigma_is_the_scatter_of_the_points(model, distance):
    """20000 columns with noise: the root of the points' total variance is sigma_m."""
    head = thesis_head(ratio=ALG1, pixel_angle=ALG2)
    column = 799.5 + head.intrinsics.fx * np.tan(np.arctan2(0.08, distance) - head.beta)
    head = replace(head, intrinsics=replace(head.intrinsics, height=20000, cy=-300.0))
    noisy = column + 0.05 * np.random.default_rng(1).standard_normal(20000)
    row = np.full(20000, 150.0)
    params = TriangulationParams(model=model)
    points, _, _ = locate(noisy, row, head, params)
    _, slope, _ = locate(np.array([column]), row[:1], head, params)
    # 20000 deviates know their standard deviation to 0.5 %; four times that is the bar.
    assert 0.05 * slope[0] == pytest.approx(np.sqrt(points.var(axis=0).sum()), rel=0.02)


@pytest.mark.parametrize("distortion", [BROWN, (-0.1, 0.03, 0.03, -0.02, 0.005)], ids=["lens", "lens off its axis"])
def test_sigma_of_a_distorted_oblique_head_is_the_derivative(distortion):
    head, row = oblique_head(distortion), np.array([100.0, 240.0, 400.0])
    column = np.array([220.0, 300.0, 500.0])
    step = 0.05
    _, slope, _ = locate(column, row, head, TriangulationParams())
    ahead, behind = (locate(column + s, row, head, TriangulationParams())[0] for s in (step, -step))
    np.testing.assert_allclose(slope, np.linalg.norm(ahead - behind, axis=1) / (2 * step), rtol=1e-4)


def test_at_the_rim_of_a_folding_lens_a_point_still_has_its_sigma():
    head = HEADS["folding lens"]
    column = np.linspace(0.0, 639.0, 3000)
    # The laser shines across the whole picture, so that every ray meets its plane.
    head = replace(head, laser_plane=np.array([0.9, 0.4, 0.0, -1.0]) / np.hypot(0.9, 0.4))
    points, slope, _ = locate(column, np.full(3000, 10.0), head, TriangulationParams())
    found = np.isfinite(points[:, 0])
    assert found[1000:2000].all()
    assert not found[[0, -1]].any()
    assert (slope[found] > 0).all()


def test_sigma_grows_with_the_column_noise_of_each_row():
    head = thesis_head(64, 48)
    line = line_at(30.0, 48)._replace(sigma_px=np.linspace(0.01, 0.5, 48))
    profile = triangulate(line, head, TriangulationParams())
    _, slope, _ = locate(line.column_px, np.arange(48.0), head, TriangulationParams())
    np.testing.assert_allclose(profile.sigma_m, slope * line.sigma_px)


# --- the profile


@pytest.mark.parametrize("model", MODELS)
def test_a_row_without_a_point_says_why_and_is_nan_throughout(model):
    head = thesis_head(ratio=ALG1, pixel_angle=ALG2)
    params = TriangulationParams(model=model, range_min_m=0.15, range_max_m=2.0)
    line = line_at(np.r_[600.0, 1300.0, 205.0, 100.0, np.nan, np.full(1195, 600.0)], 1200)
    line.reason[4] = Reason.WIDE
    profile = triangulate(line, head, params)
    beyond = Reason.BEYOND_RANGE
    np.testing.assert_array_equal(profile.reason[:5], [Reason.OK, Reason.BELOW_RANGE, beyond, beyond, Reason.WIDE])
    for name in ("points", "range_m", "sigma_m", "intensity", "column_px"):
        values = getattr(profile, name)
        assert np.isnan(values[1:5]).all(), name
        assert np.isfinite(values[0]).all(), name
    np.testing.assert_allclose(profile.range_m[0], np.linalg.norm(profile.points[0]))
    np.testing.assert_array_equal(line.reason[:4], [Reason.OK] * 4)  # the line itself is left alone


def test_a_line_of_another_height_is_refused():
    with pytest.raises(CalibrationError, match="laser line has 480 rows, the calibration 1200"):
        triangulate(line_at(600.0, 480), thesis_head(), TriangulationParams())


def test_limits_the_wrong_way_round_are_refused():
    with pytest.raises(ValueError, match=r"range_min_m 3\.0 must be below range_max_m 2\.0"):
        TriangulationParams(range_min_m=3.0, range_max_m=2.0)


# --- the window


HEADS = {
    "thesis": thesis_head(640, 480, ratio=None),
    "mirrored": replace(
        thesis_head(640, 480),
        T_head_camera=rigid(rotation_z(np.radians(25.7)) @ head_forward(), [0.0, -0.08, 0.0]),
    ),
    "short baseline": replace(
        thesis_head(640, 480), T_head_camera=rigid(rotation_z(np.radians(-20)) @ head_forward(), [0.0, 0.01, 0.0])
    ),
    "oblique": oblique_head(),
    "another": oblique_head((0.2, -0.1, 0.002, 0.001, 0.0), 7),
    "folding lens": replace(
        thesis_head(640, 480),
        intrinsics=replace(thesis_head(640, 480).intrinsics, distortion=(-0.35, 0.0, 0.0, 0.0, 0.0)),
    ),
}


def in_range(head, params, column, row):
    points, _, below = locate(column, row, head, params)
    distance = np.linalg.norm(points, axis=-1)
    return (distance >= params.range_min_m) & (distance <= params.range_max_m) & ~below


@pytest.mark.parametrize("limits", [(0.04, 8.0), (0.25, 0.6), (1.0, 1.02), (2.0, 50.0), (0.0, 3.0)])
@pytest.mark.parametrize("name", HEADS)
def test_the_window_is_every_column_of_a_return_and_no_other(name, limits):
    head = HEADS[name]
    params = TriangulationParams(range_min_m=limits[0], range_max_m=limits[1])
    window = column_window(head, params)
    assert_window(head, params, window)


@pytest.mark.parametrize("model", ["ratio", "pixel_angle"])
def test_the_window_follows_the_model(model):
    head, params = thesis_head(640, 480), TriangulationParams(model=model)
    window = column_window(head, params)
    assert_window(head, params, window)
    assert np.isfinite(window).all()


def assert_window(head, params, window):
    own = head.intrinsics
    assert window.shape == (own.height, 2)
    row = np.arange(own.height, dtype=float)
    none = np.isnan(window[:, 0])
    np.testing.assert_array_equal(none, np.isnan(window[:, 1]))
    # Truth by trying: every quarter of a pixel of the image.
    tried = np.append(np.arange(0.0, own.width - 1, 0.25), own.width - 1.0)
    some = row[::37].astype(int)
    for v in some:
        truth = in_range(head, params, tried, np.full(len(tried), float(v)))
        if none[v]:
            assert not truth.any()
            continue
        inside = (tried >= window[v, 0]) & (tried <= window[v, 1])
        assert truth[inside].all()
        outside = (tried < window[v, 0] - 0.01) | (tried > window[v, 1] + 0.01)
        assert not truth[outside].any()
    known = ~none
    for part in (0.0, 0.5, 1.0):
        column = (1 - part) * window[known, 0] + part * window[known, 1]
        assert in_range(head, params, column, row[known]).all()
    for side, step in ((0, -1.0), (1, 1.0)):
        beside = window[known, side] + step
        seen = (beside >= 0) & (beside <= own.width - 1)
        assert not in_range(head, params, beside[seen], row[known][seen]).any()


def test_rows_that_can_have_no_return_have_no_window():
    """At the right border the middle rows reach in to 50 mm; the slanting rows above and below stay farther."""
    head, params = thesis_head(640, 480), TriangulationParams(range_min_m=0.04, range_max_m=0.055)
    window = column_window(head, params)
    lost = np.isnan(window[:, 0])
    assert lost[[0, -1]].all()
    assert not lost[200:280].any()
    np.testing.assert_array_equal(window[~lost, 1], 639.0)
    assert_window(head, params, window)


def test_a_line_exactly_at_infinity_is_beyond_range():
    """The ray runs along the laser plane to the last bit; no warning, no point."""
    head = replace(thesis_head(640, 480), T_head_camera=rigid(head_forward(), [0.0, 0.08, 0.0]))
    head = replace(head, intrinsics=replace(head.intrinsics, cx=320.0))
    for model in MODELS:
        profile = triangulate(line_at(320.0, 480), replace(head, ratio=RatioModel(45.0, 0.0, 0.08, 640),
            pixel_angle=PixelAngleModel(0.125, -40.0, 0.08)), TriangulationParams(model=model))  # fmt: skip
        assert (profile.reason == Reason.BEYOND_RANGE).all()
        assert np.isnan(profile.sigma_m).all()


def test_nothing_left_of_infinity_is_in_the_window():
    window = column_window(thesis_head(), TriangulationParams(range_max_m=1e6))
    np.testing.assert_allclose(window[600], [190.46, 1599.0], atol=0.01)


def test_a_folding_lens_gives_nothing_where_it_has_no_ray():
    head = HEADS["folding lens"]
    assert isinstance(head.intrinsics, Intrinsics)
    profile = triangulate(line_at(639.0, 480), head, TriangulationParams())
    assert profile.reason[0] != Reason.OK
    assert np.isnan(profile.points[0]).all()
