"""Laws of the organised range image: what `add`, `without` and `merged` keep, and what they change."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.geometry import HeadMount, inverse, transform
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.scan.range_image import bearing_columns
from scanmap.triangulation import Profile

ROWS = 6
MOUNT = HeadMount(offset_m=(0.03, -0.01, 0.0), tilt_deg=(0.4, -0.7))
FIELDS = ("points", "range_m", "sigma_m", "intensity", "column_px", "reason")


def profile(depth, sigma=0.002, reason=None):
    """A profile whose rows lie at `depth` along x, fanned in z."""
    depth = np.broadcast_to(np.asarray(depth, float), (ROWS,)).copy()
    reason = np.full(ROWS, Reason.OK, np.uint8) if reason is None else np.asarray(reason, np.uint8)
    lost = reason != Reason.OK
    depth[lost] = np.nan
    points = np.stack([depth, 0.0 * depth, depth * np.linspace(0.4, -0.4, ROWS)], axis=-1)
    scalar = np.where(lost, np.nan, 1.0)
    return Profile(points, np.linalg.norm(points, axis=-1), sigma * scalar, 90.0 * scalar, 100.0 / depth, reason)


def scan_of(columns, mount=MOUNT):
    scan = Scan(mount, ROWS, {"source": "analytic"})
    for bearing, column in columns:
        scan.add(column, bearing)
    return scan


def assert_same(a, b, rtol=0.0):
    np.testing.assert_allclose(a.bearings, b.bearings, rtol=0, atol=1e-12 if rtol else 0)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=rtol, err_msg=name)


def random_scan(seed, count, step_deg=1.0):
    rng = np.random.default_rng(seed)
    columns = []
    for bearing in np.radians(step_deg) * np.arange(count):
        reason = np.where(rng.random(ROWS) < 0.2, Reason.WEAK, Reason.OK)
        columns.append((bearing, profile(rng.uniform(0.5, 4.0, ROWS), rng.uniform(1e-4, 1e-2, ROWS), reason)))
    return columns


def test_points_stand_in_the_world_where_the_mount_and_bearing_put_them():
    columns = random_scan(1, 7, 25.0)
    scan = scan_of(columns)
    for k, (bearing, column) in enumerate(columns):
        back = transform(inverse(MOUNT.T_world_head(bearing)), scan.points[k].astype(float))
        np.testing.assert_allclose(back, column.points, rtol=0, atol=1e-6)
        np.testing.assert_allclose(scan.origins[k], MOUNT.T_world_head(bearing)[:3, 3], atol=1e-15)


def test_a_scan_grows_past_its_first_capacity_and_keeps_every_column():
    columns = random_scan(2, 200, 0.5)
    scan = scan_of(columns)
    assert len(scan) == 200
    np.testing.assert_array_equal(scan.bearings, [b for b, _ in columns])
    np.testing.assert_array_equal(scan.reason, [p.reason for _, p in columns])
    np.testing.assert_array_equal(scan.sigma_m, np.float32([p.sigma_m for _, p in columns]))


def test_a_profile_of_another_height_is_refused():
    with pytest.raises(ValueError, match="profile has 6 rows, the scan 5"):
        Scan(HeadMount(), 5).add(profile(1.0), 0.0)


def test_an_empty_scan_is_a_scan():
    scan = Scan(HeadMount(), ROWS)
    assert len(scan.merged()) == 0
    assert scan.points.shape == (0, ROWS, 3)
    assert scan.origins.shape == (0, 3)


def test_without_takes_points_out_of_the_copy_only_and_keeps_older_reasons():
    scan = scan_of(random_scan(3, 4))
    before = scan.reason.copy()
    mask = np.zeros((4, ROWS), bool)
    mask[1:3] = True
    less = scan.without(mask, Reason.OUTLIER)
    np.testing.assert_array_equal(scan.reason, before)
    np.testing.assert_array_equal(less.reason, np.where(mask & (before == Reason.OK), Reason.OUTLIER, before))
    for name in FIELDS[:-1]:
        values = getattr(less, name)
        assert np.isnan(values[~less.valid]).all()
        np.testing.assert_array_equal(values[less.valid], getattr(scan, name)[less.valid])


@given(
    seed=st.integers(0, 2**16), count=st.integers(1, 12), step=st.sampled_from([0.003, 0.015, 0.02, 0.5, 30.0, 90.0])
)
@settings(max_examples=60, deadline=None)
def test_merging_twice_changes_nothing(seed, count, step):
    once = scan_of(random_scan(seed, count, step)).merged()
    assert_same(once.merged(), once)
    assert (np.diff(once.bearings) > np.radians(0.02)).all()


@given(seed=st.integers(0, 2**16), data=st.data())
@settings(max_examples=40, deadline=None)
def test_the_order_of_adding_is_irrelevant(seed, data):
    columns = random_scan(seed, 8, 0.5) + [(b + 1e-5, p) for b, p in random_scan(seed + 1, 8, 0.5)]
    shuffled = data.draw(st.permutations(columns))
    assert_same(scan_of(shuffled).merged(), scan_of(columns).merged(), rtol=1e-6)


def test_bearings_of_one_pass_are_only_sorted():
    columns = random_scan(4, 9, 2.0)
    assert_same(scan_of(columns[::-1]).merged(), scan_of(columns))


@given(sigma=st.floats(2e-4, 2e-2), seed=st.integers(0, 2**16))
@settings(max_examples=30, deadline=None)
def test_forward_and_backward_pass_halve_the_variance(sigma, seed):
    rng = np.random.default_rng(seed)
    bearings = np.radians(np.arange(0.0, 180.0))
    there, back = (
        [(b, profile(2.0 + rng.normal(0, sigma, ROWS), sigma)) for b in order] for order in (bearings, bearings[::-1])
    )
    single, both = scan_of(there, HeadMount()), scan_of(there + back, HeadMount()).merged()
    assert len(both) == len(single)
    averaged = np.isclose(both.sigma_m, sigma / np.sqrt(2.0), rtol=1e-6)
    assert averaged.mean() > 0.99  # 4 sigma apart by chance: 6 in 100,000 cells stay single
    depth = np.hypot(both.points[..., 0], both.points[..., 1])
    # 1080 cells: the standard deviation is known to 2.2 %; five times that is the bar.
    np.testing.assert_allclose(depth.std(), sigma / np.sqrt(2.0), rtol=0.11)


def test_the_average_is_weighted_by_the_inverse_variance():
    scan = scan_of([(0.0, profile(2.000, 0.001)), (0.0, profile(2.003, 0.002))], HeadMount()).merged()
    np.testing.assert_allclose(scan.points[0, :, 0], (4 * 2.000 + 2.003) / 5, rtol=1e-7)
    np.testing.assert_allclose(scan.sigma_m, 0.002 / np.sqrt(5.0), rtol=1e-6)


def test_where_passes_disagree_the_one_surer_of_its_column_stays_untouched():
    """Near points are exact in metres, false ones too: 0.5 mm at 1 m are more of a column than 1 mm at 2 m."""
    sure, unsure = profile(2.0, 0.001), profile(1.0, 0.0005)
    for order in ([sure, unsure], [unsure, sure]):
        merged = scan_of([(0.0, p) for p in order], HeadMount()).merged()
        np.testing.assert_array_equal(merged.points[0], np.float32(sure.points))
        np.testing.assert_allclose(merged.sigma_m, 0.001, rtol=1e-6)


def test_what_most_passes_say_stays_however_sure_the_other_is():
    passes = [profile(2.0, 0.01), profile(0.4, 0.0001), profile(2.01, 0.01)]
    for first in range(3):
        merged = scan_of([(0.0, p) for p in passes[first:] + passes[:first]], HeadMount()).merged()
        np.testing.assert_allclose(merged.points[0, :, 0], 2.005, rtol=1e-6)


def test_what_agrees_is_within_four_deviations_and_at_least_two_millimetres():
    """Of the difference, whose deviation is sqrt(2) of one's own: 4.2 mm are three of 1 mm, 8 mm are six."""
    for sigma, apart, agrees in (
        (1e-3, 4.2e-3, True),
        (1e-3, 8e-3, False),
        (1e-5, 1.5e-3, True),
        (1e-5, 2.1e-3, False),
    ):
        first, second = profile(2.0, sigma), profile(2.0 + apart, 1.01 * sigma)
        merged = scan_of([(0.0, first), (0.0, second)], HeadMount()).merged()
        middle = abs(merged.points[0, 0, 0] - 2.0 - 0.5 * apart) < 0.1 * apart
        assert middle == agrees, (sigma, apart)
        assert np.allclose(merged.sigma_m, sigma / np.sqrt(2.0), rtol=0.02) == agrees


def test_a_row_that_one_pass_missed_is_taken_from_the_other():
    lost = profile(2.0, reason=[Reason.WEAK] * 3 + [Reason.OK] * 2 + [Reason.WIDE])
    found = profile(2.0, reason=[Reason.OK] * 5 + [Reason.WEAK])
    merged = scan_of([(0.0, lost), (0.0, found)], HeadMount()).merged()
    np.testing.assert_array_equal(merged.reason[0], [Reason.OK] * 5 + [Reason.WIDE])
    np.testing.assert_array_equal(np.isnan(merged.range_m[0]), [False] * 5 + [True])
    np.testing.assert_allclose(merged.points[0, :5], profile(2.0).points[:5], rtol=1e-6)


def test_a_second_turn_falls_on_the_first():
    turn = np.radians(np.arange(0.0, 360.0, 6.0))
    columns = [(b, profile(2.0 + np.cos(b))) for b in turn]
    again = [(b + 2.0 * np.pi + 1e-4 * np.sign(b - 1.0), p) for b, p in columns]
    merged = scan_of(columns + again, HeadMount()).merged()
    assert len(merged) == len(turn)
    np.testing.assert_allclose(merged.bearings, turn, atol=1e-4)
    np.testing.assert_allclose(merged.sigma_m, 0.002 / np.sqrt(2.0), rtol=1e-6)


def test_a_sweep_finer_than_the_tolerance_does_not_become_one_column():
    bearings = np.radians(np.arange(0.0, 2.0, 0.01))
    folded, groups = bearing_columns(bearings, np.radians(0.02))
    np.testing.assert_array_equal(folded, bearings)
    assert sorted(np.concatenate(groups)) == list(range(200))
    assert max(np.ptp(bearings[group]) for group in groups) < np.radians(0.06)


def test_a_large_scan_merges_column_by_column():
    columns = random_scan(5, 30, 1.0)
    twice = scan_of(columns + columns).merged()
    once = scan_of(columns)
    np.testing.assert_allclose(twice.points, once.points, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(twice.valid, once.valid)
