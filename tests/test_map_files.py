"""Nav2's map files: what we write reads back by Nav2's rules, and so do the maps of others."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from scanmap import __version__
from scanmap.errors import ConfigError, RecordingError
from scanmap.grid import OccupancyGrid, load_map, read_nav_map, save_map

SHARED = Path(__file__).parent.parent.parent / "shared" / "data" / "maps"


def grid_of(log_odds, **kwargs):
    return OccupancyGrid(
        np.asarray(log_odds, np.float32), kwargs.pop("resolution", 0.05), (-1.35, 2.05), None, 0.605, 0.45, **kwargs
    )


def write_map(folder, pixels, *, name="m.pgm", **changes):
    """A map of somebody else; bytes are written as they are."""
    data = pixels if isinstance(pixels, bytes) else cv2.imencode(Path(name).suffix, pixels)[1].tobytes()
    (folder / name).write_bytes(data)
    keys = {
        "image": name,
        "resolution": "0.050000",
        "origin": "[-10.0, -10.0, 0.0]",
        "negate": "0",
        "occupied_thresh": "0.65",
        "free_thresh": "0.196",
    } | changes
    path = folder / "m.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in keys.items() if value is not None))
    return path


@example(np.float32([[-0.19921875, 0.42, 0.421875, 0.43, -0.21, 1e-6]]), ("png", "scale"))
@settings(max_examples=40, deadline=None)
@given(
    odds=arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(-2, 3.5, width=32)),
    form=st.sampled_from([("pgm", "trinary"), ("png", "trinary"), ("png", "scale")]),
)
def test_what_is_written_reads_back_cell_by_cell(tmp_path_factory, odds, form):
    path = tmp_path_factory.mktemp("map") / "room.yaml"
    grid = grid_of(odds)
    save_map(grid, path, *form)
    again = load_map(path)
    for name in ("occupied", "free", "unknown"):
        np.testing.assert_array_equal(getattr(again, name), getattr(grid, name), err_msg=name)
    assert (again.origin, again.resolution_m) == (grid.origin, grid.resolution_m)


@pytest.mark.parametrize("form", [("pgm", "trinary"), ("png", "trinary"), ("png", "scale")])
def test_other_programs_see_the_map_at_its_place(tmp_path, form):
    """Read by Pillow and a YAML library, nav2_map_server's rules written out; nothing of ours but the file."""
    from PIL import Image
    from ruamel.yaml import YAML

    grid = grid_of(np.random.default_rng(4).choice([-2.0, -0.3, 0.0, 0.1, 3.5], (7, 11)))
    save_map(grid, tmp_path / "m.yaml", *form)
    about = YAML(typ="safe").load(tmp_path / "m.yaml")
    with Image.open(tmp_path / about["image"]) as image:
        assert image.size == (11, 7)
        pixels = np.asarray(image.convert("RGBA"), np.float64)
    occupancy = 1.0 - pixels[..., :3].mean(axis=2) / 255.0
    occupied, free = occupancy > about["occupied_thresh"], occupancy < about["free_thresh"]
    hidden = pixels[..., 3] < 255 if about["mode"] == "scale" else np.zeros_like(occupied)
    rows, cols = np.indices(grid.shape)
    x = about["origin"][0] + (cols + 0.5) * about["resolution"]
    y = about["origin"][1] + (rows[::-1] + 0.5) * about["resolution"]  # the image's first row is the highest y
    for row, col in np.ndindex(grid.shape):
        at = grid.index(x[row, col], y[row, col])
        seen = (occupied & ~hidden)[row, col], (free & ~hidden)[row, col]
        assert seen == (grid.occupied[at], grid.free[at])


def test_unknown_is_never_read_back_as_free(tmp_path):
    grid = grid_of(np.zeros((4, 5)))
    for form in (("pgm", "trinary"), ("png", "scale")):
        save_map(grid, tmp_path / "m.yaml", *form)
        assert (read_nav_map(tmp_path / "m.yaml").values == -1).all()


def test_the_files_are_as_nav2_writes_them(tmp_path):
    """Two rows, three columns: the row of the highest y stands on top of the image."""
    grid = grid_of([[3.5, 0.0, -2.0], [-2.0, -2.0, 0.0]], resolution=0.1 / 3, comments={"source": "digital twin"})
    written = save_map(grid, tmp_path / "room.yaml")
    assert written == [tmp_path / "room.yaml", tmp_path / "room.pgm"]
    image = cv2.imread(str(tmp_path / "room.pgm"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, [[254, 254, 205], [0, 205, 254]])
    assert (tmp_path / "room.pgm").read_bytes().startswith(b"P5")
    assert (tmp_path / "room.yaml").read_text() == (
        f"# software: scanmap {__version__}\n# source: digital twin\nimage: room.pgm\nmode: trinary\n"
        "resolution: 0.03333333333333333\norigin: [-1.35, 2.05, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def test_scale_keeps_degrees_of_occupancy_and_hides_the_unseen(tmp_path):
    save_map(grid_of([[-2.0, -0.1, 0.0, 0.2, 3.5]]), tmp_path / "m.yaml", "png", "scale")
    values = read_nav_map(tmp_path / "m.yaml").values[0]
    assert values[[0, 2, 4]].tolist() == [0, -1, 100]
    assert 0 < values[1] < values[3] < 100


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        # shade 0, 60, 89, 90, 205, 206, 254, 255: occupied when (255 - shade) / 255 exceeds 0.65
        ({}, [100, 100, 100, -1, -1, 0, 0, 0]),
        ({"mode": "trinary", "free_thresh": "0.25"}, [100, 100, 100, -1, 0, 0, 0, 0]),
        ({"negate": "1"}, [0, -1, -1, -1, 100, 100, 100, 100]),
        ({"negate": "true"}, [0, -1, -1, -1, 100, 100, 100, 100]),
        ({"mode": "scale"}, [100, 100, 100, 99, 0, 0, 0, 0]),
        ({"mode": "Scale", "negate": "1"}, [0, 9, 34, 35, 100, 100, 100, 100]),
        ({"mode": "raw"}, [0, 60, 89, 90, -1, -1, -1, -1]),
        ({"mode": "raw", "negate": "1"}, [0, 60, 89, 90, -1, -1, -1, -1]),
    ],
)
def test_nav2_rules(tmp_path, changes, expected):
    """Values worked out by hand from the rules of nav2_map_server."""
    image = np.array([[0, 60, 89, 90, 205, 206, 254, 255]], np.uint8)
    np.testing.assert_array_equal(read_nav_map(write_map(tmp_path, image, **changes)).values[0], expected)


def test_alpha_counts_as_brightness_in_trinary_and_as_unknown_in_scale(tmp_path):
    image = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [254, 254, 254, 254], [205, 205, 205, 255]]], np.uint8)
    assert read_nav_map(write_map(tmp_path, image, name="m.png")).values.tolist() == [[100, 100, 0, 0]]
    assert read_nav_map(write_map(tmp_path, image, name="m.png", mode="scale")).values.tolist() == [[100, -1, -1, 0]]


@pytest.mark.parametrize(
    "data",
    [
        b"P2\n# ASCII\n3 2\n255\n0 205 254\n254 0 205\n",
        b"P5\n# Created by GIMP version 2.10.30 PNM plug-in\n3 2\n255\n" + bytes([0, 205, 254, 254, 0, 205]),
        b"P5 3 2 # white\n 127\n" + bytes([0, 102, 127, 127, 0, 102]),
        b"P2\n3 2\n10\n0 8 10\n10 0 8\n",
        b"P5\n3 2\n65535\n" + np.array([0, 205, 254, 254, 0, 205], ">u2").__mul__(257).astype(">u2").tobytes(),
    ],
    ids=["P2", "P5 from GIMP", "P5 white 127", "P2 white 10", "P5 16 bit"],
)
def test_kinds_of_pgm(tmp_path, data):
    assert read_nav_map(write_map(tmp_path, data)).values.tolist() == [[0, 100, -1], [100, -1, 0]]


@pytest.mark.parametrize("name", ["nav2/depot", "nav2/tb3_sandbox", "nav2/warehouse", "turtlebot3/map"])
def test_maps_of_others_load(name):
    path = SHARED / f"{name}.yaml"
    if not path.exists():
        pytest.skip(f"{path.name} of the shared test data is not there")
    nav = read_nav_map(path)
    image = cv2.imread(str(path.with_suffix(".pgm")), cv2.IMREAD_UNCHANGED)
    assert nav.values.shape == image.shape
    top = np.flipud(nav.values)
    assert (top[image == 0] == 100).all()
    assert (top[image >= 254] == 0).all()
    # 205 is free by the depot's own free_thresh of 0.25: the very trap our thresholds avoid.
    assert (top[image == 205] == (0 if name == "nav2/depot" else -1)).all()
    np.testing.assert_array_equal(load_map(path).to_ros(), nav.values)
    assert load_map(path).resolution_m == (0.03 if name == "nav2/warehouse" else 0.05)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image": "gone.pgm"}, "gone.pgm cannot be read"),
        ({"image": None}, "image"),
        ({"resolution": None}, "resolution is missing"),
        ({"resolution": "0"}, "above 0"),
        ({"resolution": "wide"}, "'wide'"),
        ({"origin": "[1, 2]"}, r"origin \[1, 2\]"),
        ({"origin": "[1, 2, west]"}, "'west'"),
        ({"negate": None}, "negate is missing"),
        ({"mode": "binary"}, "valid are trinary, scale, raw"),
        ({"occupied_thresh": ".nan"}, "occupied_thresh"),
        ({"mode": "scale", "free_thresh": "0.7"}, "must be below"),
        ({"origin": "[1, 2"}, "not valid YAML"),
    ],
)
def test_a_wrong_map_is_one_clear_line(tmp_path, changes, says):
    path = write_map(tmp_path, np.zeros((2, 2), np.uint8), **changes)
    with pytest.raises(RecordingError, match=says) as caught:
        read_nav_map(path)
    assert "\n" not in str(caught.value)
    assert "m.yaml" in str(caught.value)


def test_files_that_are_no_map(tmp_path):
    with pytest.raises(RecordingError, match="cannot be read"):
        load_map(tmp_path / "none.yaml")
    (tmp_path / "text.yaml").write_text("just words")
    with pytest.raises(RecordingError, match="has no keys"):
        load_map(tmp_path / "text.yaml")
    with pytest.raises(RecordingError, match="damaged or no image"):
        load_map(write_map(tmp_path, b"no image at all"))
    with pytest.raises(RecordingError, match="damaged or no image"):
        load_map(write_map(tmp_path, b""))
    with pytest.raises(RecordingError, match=r"yaw 0\.5"):
        load_map(write_map(tmp_path, np.zeros((2, 2), np.uint8), origin="[0, 0, 0.5]"))


def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path):
    grid = grid_of(np.zeros((2, 2)))
    for name, form, says in [
        ("room.pgm", (), "must end in .yaml"),
        ("room.yaml", ("pgm", "scale"), "use png"),
        ("room.yaml", ("bmp",), "pgm, png"),
        ("room.yaml", ("png", "raw"), "trinary, scale"),
        ("no/such/folder/room.yaml", (), "cannot be written"),
    ]:
        with pytest.raises(ConfigError, match=says):
            save_map(grid, tmp_path / name, *form)
    assert list(tmp_path.iterdir()) == []
