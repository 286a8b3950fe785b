"""Laws of rigid motion, of the head on its axis, and of planes and rays."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from scanmap.geometry import (
    HeadMount,
    fit_plane,
    intersect_rays_plane,
    inverse,
    is_rotation,
    rigid,
    rotation_x,
    rotation_y,
    rotation_z,
    transform,
)

angles = st.floats(-10.0, 10.0)
lengths = st.floats(-50.0, 50.0)
vectors = arrays(np.float64, 3, elements=lengths)
points = arrays(np.float64, (5, 3), elements=lengths)
quick = settings(max_examples=60, deadline=None)


@st.composite
def transforms(draw):
    a, b, c = draw(angles), draw(angles), draw(angles)
    return rigid(rotation_z(a) @ rotation_y(b) @ rotation_x(c), draw(vectors))


@given(T=transforms())
@quick
def test_a_transform_and_its_inverse_cancel_either_way(T):
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(inverse(inverse(T)), T, atol=1e-12)


@given(A=transforms(), B=transforms(), C=transforms(), p=points)
@quick
def test_transforms_are_a_group_that_acts_on_points(A, B, C, p):
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-10)
    np.testing.assert_allclose(transform(A @ B, p), transform(A, transform(B, p)), atol=1e-10)
    np.testing.assert_allclose(transform(np.eye(4), p), p, atol=0)
    np.testing.assert_allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=1e-10)


@given(T=transforms(), p=points)
@quick
def test_rigid_motion_keeps_distances_and_handedness(T, p):
    q = transform(T, p)
    np.testing.assert_allclose(
        np.linalg.norm(q[1:] - q[:-1], axis=1), np.linalg.norm(p[1:] - p[:-1], axis=1), atol=1e-9
    )
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    assert is_rotation(T[:3, :3])


@given(T=transforms(), p=vectors)
@quick
def test_points_of_any_shape_are_moved_alike(T, p):
    many = np.broadcast_to(p, (2, 4, 3))
    np.testing.assert_allclose(transform(T, many)[1, 2], transform(T, p), atol=1e-12)


@pytest.mark.parametrize(
    ("rotation", "about", "turned", "into"),
    [(rotation_x, 0, 1, 2), (rotation_y, 1, 2, 0), (rotation_z, 2, 0, 1)],
)
def test_rotations_turn_by_the_right_hand_rule(rotation, about, turned, into):
    np.testing.assert_allclose(rotation(np.pi / 2)[:, turned], np.eye(3)[into], atol=1e-15)
    np.testing.assert_allclose(rotation(0.7)[:, about], np.eye(3)[about], atol=1e-15)
    np.testing.assert_allclose(rotation(0.3) @ rotation(0.4), rotation(0.7), atol=1e-15)


def test_a_reflection_or_a_stretched_matrix_is_no_rotation():
    assert is_rotation(np.eye(3))
    assert not is_rotation(np.diag([1.0, 1.0, -1.0]))
    assert not is_rotation(1.01 * np.eye(3))


@given(
    offset=st.tuples(lengths, lengths, lengths), tilt=st.tuples(st.floats(-5, 5), st.floats(-5, 5)), bearing=angles,
    p=vectors,
)  # fmt: skip
@quick
def test_the_head_stands_on_the_axis_as_the_formula_says(offset, tilt, bearing, p):
    """p_world = Rz(bearing) (Ry(tilt_y) Rx(tilt_x) p_head + offset), written out by sines and cosines."""
    x, y, z = p
    a, b = np.radians(tilt)
    y, z = np.cos(a) * y - np.sin(a) * z, np.sin(a) * y + np.cos(a) * z
    x, z = np.cos(b) * x + np.sin(b) * z, -np.sin(b) * x + np.cos(b) * z
    x, y, z = x + offset[0], y + offset[1], z + offset[2]
    world = np.cos(bearing) * x - np.sin(bearing) * y, np.sin(bearing) * x + np.cos(bearing) * y, z
    mount = HeadMount(offset, tilt)
    np.testing.assert_allclose(transform(mount.T_world_head(bearing), p), world, atol=1e-10)
    np.testing.assert_allclose(mount.T_world_head(0.0), mount.T_axis_head(), atol=1e-12)


def test_the_bearing_counts_to_the_left():
    ahead = np.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(transform(HeadMount().T_world_head(np.pi / 2), ahead), [0.0, 2.0, 0.0], atol=1e-15)


@given(
    normal=arrays(np.float64, 3, elements=st.floats(-1, 1)), d=st.floats(-5, 5), origin=vectors,
    rays=arrays(np.float64, (6, 3), elements=st.floats(-1, 1)),
)  # fmt: skip
@quick
def test_rays_meet_the_plane_on_the_plane(normal, d, origin, rays):
    assume(np.linalg.norm(normal) > 0.1)
    normal = normal / np.linalg.norm(normal)
    t = intersect_rays_plane(origin, rays, np.append(normal, d))
    met = np.isfinite(t) & (np.abs(rays @ normal) > 1e-3)
    on_plane = (origin + t[met, None] * rays[met]) @ normal + d
    np.testing.assert_allclose(on_plane, 0.0, atol=1e-9)
    assert np.isfinite(t[np.abs(rays @ normal) > 1e-3]).all()


def test_a_parallel_ray_meets_nothing_and_one_behind_is_negative():
    plane = np.array([1.0, 0.0, 0.0, -2.0])
    rays = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(intersect_rays_plane(np.zeros(3), rays, plane), [np.nan, 2.0, -2.0])
    assert intersect_rays_plane(np.zeros(3), rays[1], plane) == 2.0
    assert np.isnan(intersect_rays_plane(np.zeros(3), rays[0], plane))


@given(T=transforms(), seed=st.integers(0, 2**16), noise=st.sampled_from([0.0, 1e-3, 1e-2]))
@quick
def test_a_plane_fit_finds_the_plane_and_its_noise(T, seed, noise):
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-1, 1, (2000, 3)) * [1.0, 1.0, 0.0]
    flat[:, 2] += noise * rng.standard_normal(2000)
    fit = fit_plane(transform(T, flat))
    assert abs(fit.normal @ T[:3, 2]) > np.cos(4.0 * noise / np.sqrt(2000 / 3) + 1e-7)
    assert np.linalg.norm(fit.normal) == pytest.approx(1.0, abs=1e-12)
    assert abs(fit.normal @ T[:3, 3] + fit.d) < 5.0 * noise / np.sqrt(2000) + 1e-9
    # The standard deviation of 2000 deviates is known to 1.6 %; five times that is the bar.
    assert fit.rms_m == pytest.approx(noise, rel=0.08, abs=1e-6)
