"""Files of a scan: what is written comes back bit for bit, and other people's programs see every attribute."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from analytic_scan import box_scan
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanmap import raycast
from scanmap.errors import ConfigError, RecordingError
from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.scan.formats import CLOUDS, MESHES, check_writable, read_ply, read_points, write
from scanmap.scan.mesh import mesh
from scanmap.scan.surface import normals

FIELDS = ("points", "range_m", "sigma_m", "intensity", "column_px")
ATTRIBUTES = ("intensity", "sigma", "range", "column", "bearing_index", "row")
MOUNT = HeadMount((0.031, -0.02, 0.1), (0.3, -1.7))


def holed(seed=0, step=7.3, mount=MOUNT):
    """A scan with points missing for all sorts of reasons."""
    scan = box_scan(np.arange(11.0, 140.0, step), 48, sigma_px=0.02, seed=seed, mount=mount)
    rng = np.random.default_rng(seed)
    scan.comments |= {"source": "digital twin", "scanmap": "0.1.0"}
    return scan.without(rng.random(scan.valid.shape) < 0.2, Reason.WEAK).without(scan.range_m > 2.4, Reason.OUTLIER)


def attribute(scan, name):
    """What the file must hold under `name`, in the order of its points."""
    if name in ("bearing_index", "row"):
        return np.nonzero(scan.valid)[name == "row"]
    field = {"sigma": "sigma_m", "range": "range_m", "column": "column_px"}.get(name, name)
    return getattr(scan, field)[scan.valid]


@pytest.fixture(scope="module")
def scan():
    return holed()


@pytest.fixture(scope="module")
def ply(scan, tmp_path_factory):
    path = tmp_path_factory.mktemp("ply") / "room.ply"
    write(scan, path)
    return path


# --- our own reader


def assert_restored(read, scan):
    np.testing.assert_array_equal(read.bearings, scan.bearings)
    assert read.mount == scan.mount
    assert read.rows == scan.rows
    assert read.comments == scan.comments
    np.testing.assert_array_equal(read.valid, scan.valid)
    assert set(np.unique(read.reason)) <= {Reason.OK, Reason.NOT_SCANNED}
    for name in FIELDS:
        own, other = getattr(scan, name), getattr(read, name)
        assert own.dtype == other.dtype
        assert other[scan.valid].tobytes() == own[scan.valid].tobytes(), name
        assert np.isnan(other[~scan.valid]).all()


def test_a_scan_comes_back_bit_for_bit(scan, ply):
    assert_restored(read_ply(ply), scan)


finite = st.floats(-10.0, 10.0, allow_subnormal=True)
jsonish = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=700)


@given(
    seed=st.integers(0, 999),
    offset=st.tuples(finite, finite, finite),
    tilt=st.tuples(finite, finite),
    turn=st.floats(-400.0, 400.0),
    comments=st.dictionaries(
        st.from_regex(r"[A-Za-z_][A-Za-z0-9_. -]{0,20}[a-z0-9]", fullmatch=True).filter(
            lambda key: key not in ("rows", "units", "frame", "sweep", "head_offset_m", "tilt_deg", "bearings_rad")
        ),
        jsonish | st.lists(jsonish, max_size=3) | st.dictionaries(st.text(max_size=5), jsonish, max_size=3),
        max_size=5,
    ),
)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mount_bearings_and_comments_of_any_kind_survive(tmp_path, seed, offset, tilt, turn, comments):
    base = holed(seed, step=31.7)
    fields = {name: getattr(base, name) for name in (*FIELDS, "reason")}
    bearings = np.radians(turn) + base.bearings * np.pi / 3.0
    scan = Scan.from_arrays(HeadMount(offset, tilt), bearings, fields, comments)
    write(scan, tmp_path / "any.ply")
    assert_restored(read_ply(tmp_path / "any.ply"), scan)
    header = (tmp_path / "any.ply").read_bytes().split(b"end_header")[0]
    assert max(len(line) for line in header.split(b"\n")) < 256  # readers in C have short buffers


def test_a_long_comment_is_spread_over_lines(tmp_path, scan):
    fields = {name: getattr(scan, name) for name in (*FIELDS, "reason")}
    rig = "[sweep]\nstep_deg = 1.0  # Grad über alles\n" * 100
    told = Scan.from_arrays(MOUNT, scan.bearings, fields, {"rig": rig, "words": "x y " * 500 + "z"})
    write(told, tmp_path / "told.ply")
    assert_restored(read_ply(tmp_path / "told.ply"), told)
    header = (tmp_path / "told.ply").read_bytes().split(b"\nend_header\n")[0]
    assert max(len(line) for line in header.split(b"\n")) < 256
    cloud = raycast.load_open3d().t.io.read_point_cloud(str(tmp_path / "told.ply"))
    np.testing.assert_array_equal(cloud.point.positions.numpy(), scan.points[scan.valid])


def test_a_scan_written_in_several_blocks_comes_back(tmp_path):
    scan = box_scan(np.arange(0.0, 150.0, 1.0), 12)
    write(scan, tmp_path / "long.ply")
    assert_restored(read_ply(tmp_path / "long.ply"), scan)


def test_a_comment_cannot_pass_for_the_geometry(tmp_path, scan):
    fields = {name: getattr(scan, name) for name in (*FIELDS, "reason")}
    sly = Scan.from_arrays(MOUNT, scan.bearings, fields, {"rows": 3, "end_header\nelement": "x\nend_header\n"})
    write(sly, tmp_path / "sly.ply")
    read = read_ply(tmp_path / "sly.ply")
    assert read.rows == scan.rows
    assert read.comments["rows_"] == 3
    np.testing.assert_array_equal(read.points, np.where(scan.valid[..., None], scan.points, np.nan))


def test_a_scan_without_points_comes_back(tmp_path):
    empty = box_scan(np.arange(3.0), 12, range_max=0.01)
    write(empty, tmp_path / "empty.ply")
    read = read_ply(tmp_path / "empty.ply")
    assert len(read) == 3
    assert not read.valid.any()
    write(Scan(HeadMount(), 4), tmp_path / "none.ply")
    assert len(read_ply(tmp_path / "none.ply")) == 0


def test_points_taken_out_by_another_program_stay_out(tmp_path, scan, ply):
    from plyfile import PlyData, PlyElement

    file = PlyData.read(str(ply))
    keep = np.arange(len(file["vertex"].data)) % 3 > 0
    PlyData([PlyElement.describe(file["vertex"].data[keep], "vertex")], comments=file.comments, byte_order="<").write(
        str(tmp_path / "cropped.ply")
    )
    read = read_ply(tmp_path / "cropped.ply")
    assert read.valid.sum() == keep.sum()
    np.testing.assert_array_equal(read.points[read.valid], scan.points[scan.valid][keep])


# --- other readers


def test_header_says_units_source_and_geometry(ply):
    header = ply.read_bytes().split(b"end_header")[0].decode()
    for line in (
        "format binary_little_endian 1.0", "comment source: digital twin", "comment scanmap: 0.1.0",
        "comment head_offset_m: 0.031 -0.02 0.1", "comment tilt_deg: 0.3 -1.7", "comment rows: 48", "property float x",
        "property float sigma", "property int bearing_index", "property int row",
    ):  # fmt: skip
        assert f"\n{line}\n" in header
    assert "[m]" in header
    assert "deg" in header


def test_plyfile_sees_every_attribute(scan, ply):
    from plyfile import PlyData

    vertex = PlyData.read(str(ply))["vertex"]
    points = np.stack([vertex[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_array_equal(points, scan.points[scan.valid])
    normal = np.stack([vertex[f"n{axis}"] for axis in "xyz"], axis=-1)
    np.testing.assert_array_equal(normal, np.nan_to_num(normals(scan)[scan.valid]))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(vertex[name], attribute(scan, name))


def test_trimesh_sees_points_and_attributes(scan, ply):
    import trimesh

    cloud = trimesh.load(str(ply))
    np.testing.assert_array_equal(cloud.vertices.astype(np.float32), scan.points[scan.valid])
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(data[name].ravel(), attribute(scan, name))


@pytest.mark.parametrize("ending", ["ply", "pcd"])
def test_open3d_sees_every_attribute(scan, tmp_path, ending):
    o3d = raycast.load_open3d()
    path = tmp_path / f"room.{ending}"
    write(scan, path)
    cloud = o3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(cloud.point.positions.numpy(), scan.points[scan.valid])
    np.testing.assert_array_equal(cloud.point.normals.numpy(), np.nan_to_num(normals(scan)[scan.valid]))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(cloud.point[name].numpy().ravel(), attribute(scan, name))
    legacy = o3d.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(np.asarray(legacy.points, np.float32), scan.points[scan.valid])
    assert legacy.has_normals()


def test_xyz_is_read_by_open3d_and_numpy(scan, tmp_path):
    o3d = raycast.load_open3d()
    path = tmp_path / "room.xyz"
    write(scan, path)
    points = scan.points[scan.valid]
    np.testing.assert_allclose(np.loadtxt(path), points, atol=6e-7)
    np.testing.assert_allclose(np.asarray(o3d.io.read_point_cloud(str(path)).points), points, atol=6e-7)


def test_pcd_header_follows_pcl(scan, tmp_path):
    path = tmp_path / "room.pcd"
    write(scan, path)
    data = path.read_bytes()
    header, _, body = data.partition(b"DATA binary\n")
    words = {line.split()[0]: line.split()[1:] for line in header.decode().splitlines() if not line.startswith("#")}
    count = int(scan.valid.sum())
    assert words["FIELDS"][:7] == ["x", "y", "z", "normal_x", "normal_y", "normal_z", "intensity"]
    assert len(words["FIELDS"]) == len(words["SIZE"]) == len(words["TYPE"]) == len(words["COUNT"]) == 12
    assert (words["WIDTH"], words["HEIGHT"], words["POINTS"]) == ([str(count)], ["1"], [str(count)])
    assert len(body) == count * 48
    assert b"# source: digital twin\n" in header


# --- meshes


@pytest.mark.parametrize("name", ["room.glb", "room.stl", "room.obj", "room-mesh.ply"])
def test_meshes_are_read_by_trimesh(scan, tmp_path, name):
    import trimesh

    path = tmp_path / name
    write(scan, path)
    built = trimesh.load(str(path), force="mesh", process=False)
    own = mesh(scan)
    corners = own.vertices[own.triangles]
    read = np.asarray(built.triangles)
    if name.endswith(".glb"):  # y up in the file
        read = np.stack([read[..., 0], -read[..., 2], read[..., 1]], axis=-1)
    assert len(read) == len(corners) > 500
    np.testing.assert_allclose(read, corners, atol=1e-6)
    if name != "room.stl":
        assert len(built.vertices) == len(np.unique(own.triangles))


def test_facets_of_an_stl_have_the_normal_of_their_corners(scan, tmp_path):
    write(scan, tmp_path / "room.stl")
    data = (tmp_path / "room.stl").read_bytes()
    facets = np.frombuffer(data, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("free", "<u2")], offset=84)
    a, b, c = np.moveaxis(facets["corners"].astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    assert len(facets) == struct.unpack_from("<I", data, 80)[0] > 500
    np.testing.assert_allclose((facets["normal"] * normal).sum(axis=1), 1.0, atol=1e-3)


def test_mesh_says_where_it_comes_from(scan, tmp_path):
    for name in ("room.glb", "room.stl", "room.obj", "room.mesh.ply"):
        write(scan, tmp_path / name)
        assert b"digital twin" in (tmp_path / name).read_bytes()[:4000], name


def test_glb_keeps_the_rules_of_its_container(scan, tmp_path):
    path = tmp_path / "room.glb"
    write(scan, path)
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    assert length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    (binary,) = struct.unpack_from("<I", data, 20 + length)
    assert binary == document["buffers"][0]["byteLength"] == len(data) - 28 - length
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    position = document["accessors"][1]
    vertices = np.frombuffer(data, "<f4", 3 * position["count"], 28 + length + document["bufferViews"][1]["byteOffset"])
    np.testing.assert_array_equal(vertices.reshape(-1, 3).min(axis=0), np.float32(position["min"]))
    np.testing.assert_array_equal(vertices.reshape(-1, 3).max(axis=0), np.float32(position["max"]))


def test_open3d_reads_the_mesh(scan, tmp_path):
    o3d = raycast.load_open3d()
    for name in ("room.mesh.ply", "room.stl", "room.glb"):
        write(scan, tmp_path / name)
        built = o3d.io.read_triangle_mesh(str(tmp_path / name))
        assert len(built.triangles) == len(mesh(scan).triangles), name
    coloured = o3d.io.read_triangle_mesh(str(tmp_path / "room.mesh.ply"))
    assert coloured.has_vertex_colors()
    assert coloured.has_vertex_normals()


def test_a_scan_without_a_surface_gives_no_mesh(tmp_path):
    empty = box_scan(np.arange(3.0), 12, range_max=0.01)
    for name in ("a.glb", "a.stl", "a.obj", "mesh.ply"):
        with pytest.raises(RecordingError, match="no mesh: of 0 points"):
            write(empty, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


# --- files of others, and damaged ones


def test_points_of_any_ply_can_be_read(tmp_path):
    points = np.array([[0.5, 1.25, -2.0], [3.0, 0.0, 1e-3]])
    records = np.array([(7, *p) for p in points], [("tag", "u1"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    properties = "property uchar tag\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    for form, body in (
        ("ascii", "".join(f"7 {x} {y} {z}\n" for x, y, z in points).encode()),
        ("binary_little_endian", records.astype(records.dtype.newbyteorder("<")).tobytes()),
        ("binary_big_endian", records.astype(records.dtype.newbyteorder(">")).tobytes()),
    ):
        path = tmp_path / f"{form}.ply"
        path.write_bytes(f"ply\nformat {form} 1.0\nelement vertex 2\n{properties}".encode() + body)
        np.testing.assert_array_equal(read_points(path), points)
        with pytest.raises(RecordingError, match=r"it lacks nx, ny, .*row, the comment rows"):
            read_ply(path)


def test_read_points_of_our_own(scan, ply):
    np.testing.assert_array_equal(read_points(ply), scan.points[scan.valid])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "does not begin with ply"),
        (b"\x89PNG\r\n", "does not begin with ply"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n", "a header"),
        (b"ply\nelement vertex 0\nend_header\n", "its format is missing; valid: ascii"),
        (b"ply\nformat hieroglyphs 1.0\nelement vertex 0\nend_header\n", "its format is hieroglyphs; valid"),
        (b"ply\nformat ascii 1.0\nend_header\n", "its first element is missing"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "its first element is face"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n", "how many vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n", "does not read"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n1\n", "does not read"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "1 of 2 vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\nwall\n", "wall"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1234", "buffer"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float q\nend_header\n1\n", "has no x y z"),
    ],
)
def test_what_is_no_ply_is_named(tmp_path, content, words):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=words):
        read_points(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"gone\.ply cannot be read: No such file"):
        read_ply(tmp_path / "gone.ply")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"comment rows: 48", b"comment rows: 10"),
        (b"comment rows: 48", b"comment rows: 47"),
        (b"comment rows: 48", b"comment rows: -8"),
        (b"comment rows: 48", b"comment rows: xx"),
        (b"comment tilt_deg: 0.3 -1.7", b"comment tilt_deg: 0.3     "),
        (b"comment rows: 48", b"comment rows: 99999999999"),
        (b"comment rows: 48", b"comment rows: 900000000"),
        (b"comment tilt_deg: 0.3 -1.7", b"comment tilt_deg: nan -1.7"),
    ],
)
def test_damaged_geometry_is_an_error_not_a_wrong_scan(ply, tmp_path, old, new):
    data = ply.read_bytes()
    assert old in data
    path = tmp_path / "damaged.ply"
    path.write_bytes(data.replace(old, new))
    with pytest.raises(RecordingError, match="is damaged"):
        read_ply(path)


@pytest.mark.parametrize(("offset", "words"), [(40, "two points in one cell"), (0, "not finite")])
def test_records_that_no_scan_has_are_damage(ply, tmp_path, offset, words):
    """The second point given the first one's bearing and row, or an x that is NaN."""
    data = bytearray(ply.read_bytes())
    first = data.index(b"end_header\n") + 11
    second = first + 48
    data[second + offset : second + 48] = (
        data[first + offset : second] if offset else struct.pack("<f", np.nan) + data[second + 4 : second + 48]
    )
    path = tmp_path / "damaged.ply"
    path.write_bytes(bytes(data))
    with pytest.raises(RecordingError, match=words):
        read_ply(path)


@given(cut=st.integers(0, 10_000), flip=st.integers(0, 10_000), value=st.integers(0, 255))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_damage_ends_in_one_clear_error_or_a_scan(ply, tmp_path, cut, flip, value):
    data = bytearray(ply.read_bytes())
    data[flip % 2000] = value  # the header, where it hurts
    path = tmp_path / "hurt.ply"
    path.write_bytes(bytes(data[: len(data) - cut]))
    try:
        assert read_ply(path).rows > 0
    except RecordingError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)


# --- writing


def test_an_unknown_ending_lists_the_valid_ones(scan, tmp_path):
    for call in (check_writable, lambda path: write(scan, path)):
        with pytest.raises(ConfigError, match=r"\.las is not a kind .*\.ply, \.pcd, \.xyz, \.glb, \.stl"):
            call(tmp_path / "room.las")
        with pytest.raises(ConfigError, match="no ending is not a kind"):
            call(tmp_path / "room")


def test_what_cannot_be_written_is_known_before_the_scan(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"there is no folder .*nowhere; create it with mkdir -p"):
        check_writable(tmp_path / "nowhere" / "room.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ConfigError, match="it is a folder"):
        check_writable(tmp_path / "folder.ply")
    for path in (tmp_path / "room.ply", str(tmp_path / "ROOM.PLY")):
        check_writable(path)
    (tmp_path / "kept.ply").write_bytes(b"")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ConfigError, match="it is write-protected"):
        check_writable(tmp_path / "kept.ply")


def test_a_folder_that_takes_no_file_is_named():
    if not Path("/proc/self").is_dir():
        pytest.skip("needs /proc, a folder in which nobody can create a file")
    with pytest.raises(ConfigError, match=r"room\.ply cannot be written: /proc/self: .*choose another folder"):
        check_writable("/proc/self/room.ply")


def test_who_reads_the_old_file_reads_it_whole(scan, tmp_path):
    """The new file takes the name; the old one is never written into."""
    path, old = tmp_path / "room.ply", tmp_path / "old.ply"
    path.write_bytes(b"an older scan")
    os.link(path, old)
    write(scan, path)
    assert old.read_bytes() == b"an older scan"
    assert len(read_ply(path)) == len(scan)


@pytest.mark.parametrize("ending", [*CLOUDS, *MESHES])
def test_a_failed_write_leaves_the_old_file_and_no_other(scan, tmp_path, monkeypatch, ending):
    path = tmp_path / f"room{ending}"
    path.write_bytes(b"what was there")

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write(scan, path)
    assert path.read_bytes() == b"what was there"
    assert list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    write(scan, path)
    assert path.stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [path]
