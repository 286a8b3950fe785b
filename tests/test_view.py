"""The view: what stands in its recordings, read back without a viewer; and that it never stops a scan."""

import logging
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from scanmap.calibration import Calibration, CalibrationFile
from scanmap.errors import ConfigError
from scanmap.geometry import inverse, transform
from scanmap.grid import Floor, OccupancyGrid
from scanmap.laserline import LaserLine, Reason
from scanmap.pipeline import Step
from scanmap.scan import Scan
from scanmap.shot import Shot, decode_image, encode_png
from scanmap.triangulation import (
    TriangulationParams,
    pixel_angle_depth,
    pixel_angle_model_of,
    ratio_depth,
    ratio_model_of,
    triangulate,
)
from scanmap.view import View, ViewParams, open_view, show, viewer
from scanmap.view import entities as at
from scanmap.view.blueprint import eye_over
from scanmap.view.boards import write_boards
from scanmap.view.pictures import jpeg, shrink_factor, shrunk, shrunk_lines
from scanmap.view.scene import height_colours, laser_fan
from scanmap.view.thesis_view import painted

W, H = 160, 120
ROWS = np.arange(H, dtype=np.float64)
STEPS = 7


def head(**axis: Any) -> Calibration:
    document = {
        "image": {"width": W, "height": H},
        "head": {"baseline_m": 0.08, "beta_deg": 25.7, "alpha_deg": 32.3},
        "axis": {"head_offset_m": (0.03, 0.01, 0.0), "tilt_deg": (1.0, -2.0)} | axis,
    }
    return CalibrationFile.model_validate(document).build()


HEAD = head()


def one_step(index: int, *, bearing: float = 0.0, image: bytes | None = None, lost: slice = slice(0, 10)) -> Step:
    """A shot with a slanted line, of which the rows of `lost` were not found."""
    column = 40.25 + 0.1 * ROWS + index
    reason = np.zeros(H, np.uint8)
    reason[lost] = Reason.WEAK
    column[lost] = np.nan
    line = LaserLine(column, np.full(H, 100.0), np.full(H, 1.2), np.full(H, 0.1), reason)
    if image is None:
        pixels = np.zeros((H, W, 3), np.uint8)
        at_column = 40.25 + 0.1 * ROWS + index
        left = np.floor(at_column).astype(int)
        pixels[np.arange(H), left, 2] = 250 * (1.0 - (at_column - left))
        pixels[np.arange(H), left + 1, 2] = 250 * (at_column - left)
        image = encode_png(pixels)
    shot = Shot(index, bearing, bearing - 0.001, 100.0 + 0.5 * index, image)
    return Step(shot, line, triangulate(line, HEAD, TriangulationParams()))


def steps() -> list[Step]:
    return [one_step(k, bearing=0.4 * k) for k in range(STEPS)]


def opened(rrd: Path | None, live_port: int | None = None, **params: Any) -> View:
    return open_view(
        calibration=HEAD,
        params=ViewParams(**params),
        settings_toml='[sweep]\nstep_deg = 6.0\nnote = "a"',
        title="test rig",
        is_twin=True,
        rrd=rrd,
        live_port=live_port,
    )


def recorded(rrd: Path, made: list[Step], **params: Any) -> "Recorded":
    with opened(rrd, **params) as view:
        for step in made:
            view.step(step)
    return Recorded(rrd)


class Recorded:
    """An .rrd read back."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self.reader = RrdReader(str(path))
        self.batches = [(c.entity_path, c.is_static, c.to_record_batch()) for c in self.reader.store().stream()]

    def rows(self, entity: str, component: str, *, static: bool = False) -> dict[int | None, Any]:
        """Values of one component by shot; by None if static."""
        found: dict[int | None, Any] = {}
        for path, is_static, batch in self.batches:
            if path == f"/{entity}" and is_static == static and component in batch.schema.names:
                shots = [None] if static else batch.column("shot").to_pylist()
                found |= dict(zip(shots, batch.column(component).to_pylist(), strict=True))
        return found

    def matrix(self, entity: str, shot: int | None) -> Any:
        static = shot is None
        T = np.eye(4)
        # The viewer stores matrices by columns.
        T[:3, :3] = np.reshape(self.rows(entity, "Transform3D:mat3x3", static=static)[shot], (3, 3)).T
        T[:3, 3] = np.ravel(self.rows(entity, "Transform3D:translation", static=static)[shot])
        return T


@pytest.fixture(scope="module")
def scan_rrd(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return recorded(tmp_path_factory.mktemp("view") / "scan.rrd", steps(), thesis_every=3)


@pytest.mark.parametrize(
    ("entity", "component"),
    [
        (at.HEAD, "Transform3D:mat3x3"),
        (at.POINTS, "Points3D:positions"),
        (at.IMAGE, "EncodedImage:blob"),
        (at.LINE, "Points2D:positions"),
        (at.BEARING, "Scalars:scalars"),
        (at.ROWS, "Scalars:scalars"),
        (at.THESIS_PPX, "Scalars:scalars"),
        (at.THESIS_P, "Scalars:scalars"),
        (f"{at.THESIS_DISTANCE}/algorithm_1", "Scalars:scalars"),
        (f"{at.THESIS_DISTANCE}/algorithm_2", "Scalars:scalars"),
        (f"{at.THESIS_DISTANCE}/calibrated", "Scalars:scalars"),
    ],
)
def test_every_shot_is_there(scan_rrd: Recorded, entity: str, component: str) -> None:
    assert sorted(scan_rrd.rows(entity, component)) == list(range(STEPS))


def test_head_stands_where_geometry_says(scan_rrd: Recorded) -> None:
    for step in steps():
        T = scan_rrd.matrix(at.HEAD, step.shot.index)
        np.testing.assert_allclose(T, HEAD.mount.T_world_head(step.shot.bearing), atol=1e-6)
    np.testing.assert_allclose(scan_rrd.matrix(at.CAMERA, None), HEAD.T_head_camera, atol=1e-6)


def test_points_stand_in_the_world(scan_rrd: Recorded) -> None:
    for step in steps():
        found = step.profile.points[step.profile.reason == Reason.OK]
        expected = transform(HEAD.mount.T_world_head(step.shot.bearing), found)
        positions = scan_rrd.rows(at.POINTS, "Points3D:positions")[step.shot.index]
        np.testing.assert_allclose(positions, expected, atol=1e-6)


def test_camera_bytes_are_untouched(scan_rrd: Recorded) -> None:
    blobs = scan_rrd.rows(at.IMAGE, "EncodedImage:blob")
    for step in steps():
        assert bytes(blobs[step.shot.index][0]) == step.shot.image


@pytest.mark.parametrize("width_px", [0, 80])
def test_points_project_onto_the_line_in_the_picture(tmp_path: Path, width_px: int) -> None:
    """Through the recording's own transforms and pinhole, as the viewer sees it: pixel centres at 0.5."""
    made = recorded(tmp_path / "p.rrd", steps(), image_width_px=width_px, thesis_tab=False)
    K = np.reshape(made.rows(at.IMAGE, "Pinhole:image_from_camera", static=True)[None], (3, 3)).T
    for k in range(STEPS):
        T_camera_world = inverse(made.matrix(at.HEAD, k) @ made.matrix(at.CAMERA, None))
        points = transform(T_camera_world, np.array(made.rows(at.POINTS, "Points3D:positions")[k]))
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
        np.testing.assert_allclose(pixels, made.rows(at.LINE, "Points2D:positions")[k], atol=2e-3)


def test_line_lies_in_the_picture_made_smaller(tmp_path: Path) -> None:
    made = recorded(tmp_path / "small.rrd", steps()[:1], image_width_px=80, jpeg_quality=100, thesis_tab=False)
    picture = decode_image(bytes(made.rows(at.IMAGE, "EncodedImage:blob")[0][0])).image
    assert picture.shape == (H // 2, W // 2, 3)
    assert made.rows(at.IMAGE, "Pinhole:resolution", static=True)[None] == [[W // 2, H // 2]]
    line = np.array(made.rows(at.LINE, "Points2D:positions")[0])
    red = picture[10:, :, 2] * (picture[10:, :, 2] > 4.0)
    # In the viewer's coordinates, where the centre of the first pixel is 0.5.
    seen = (red @ (np.arange(W // 2) + 0.5)) / red.sum(axis=1)
    drawn = line[line[:, 1] >= 5.0, 0].reshape(-1, 2).mean(axis=1)[5:]
    np.testing.assert_allclose(seen, drawn, atol=0.25)  # a block does not tell where in it the line is
    assert abs((seen - drawn).mean()) < 0.03


def test_picture_and_line_come_together(tmp_path: Path) -> None:
    made = recorded(tmp_path / "few.rrd", steps(), image_every=3, thesis_tab=False)
    assert sorted(made.rows(at.IMAGE, "EncodedImage:blob")) == [0, 3, 6]
    assert sorted(made.rows(at.LINE, "Points2D:positions")) == [0, 3, 6]
    assert sorted(made.rows(at.HEAD, "Transform3D:mat3x3")) == list(range(STEPS))
    assert not [path for path, _, _ in made.batches if path.startswith(f"/{at.THESIS}")]


def test_points_are_thinned_out(tmp_path: Path) -> None:
    made = recorded(tmp_path / "thin.rrd", steps()[:1], max_points_per_shot=25, image_every=0)
    positions = np.array(made.rows(at.POINTS, "Points3D:positions")[0])
    assert 20 <= len(positions) <= 25
    all_points = recorded(tmp_path / "all.rrd", steps()[:1]).rows(at.POINTS, "Points3D:positions")[0]
    assert len(all_points) == H - 10
    assert not made.rows(at.IMAGE, "EncodedImage:blob")


def test_a_ceiling_can_be_hidden(tmp_path: Path) -> None:
    whole = np.array(recorded(tmp_path / "a.rrd", steps()[:1]).rows(at.POINTS, "Points3D:positions")[0])
    limit = float(np.median(whole[:, 2]))
    cut = recorded(tmp_path / "b.rrd", steps()[:1], hide_above_m=max(limit, 1e-3))
    low = np.array(cut.rows(at.POINTS, "Points3D:positions")[0])
    high = np.array(cut.rows(at.POINTS_ABOVE, "Points3D:positions")[0])
    assert low[:, 2].max() <= max(limit, 1e-3) < high[:, 2].min()
    assert len(low) + len(high) == len(whole)


def test_plots_and_states(scan_rrd: Recorded, tmp_path: Path) -> None:
    bearings = scan_rrd.rows(at.BEARING, "Scalars:scalars")
    np.testing.assert_allclose(bearings[2], np.degrees([0.799, 0.8]))
    assert scan_rrd.rows(at.ROWS, "Scalars:scalars")[2] == [H - 10]
    made = recorded(
        tmp_path / "s.rrd", [one_step(0), one_step(1, lost=slice(0, 100)), one_step(2, lost=slice(None)), one_step(3)]
    )
    assert list(made.rows(at.LINE_STATE, "StateChange:state").values()) == [
        ["line found"], ["few rows"], ["no line"], ["line found"],
    ]  # fmt: skip
    assert ["scanning"] in made.rows(at.SCAN_STATE, "StateChange:state").values()


def test_thesis_numbers_are_the_formulas(tmp_path: Path) -> None:
    made = recorded(tmp_path / "t.rrd", steps(), row=77)
    for k, step in enumerate(steps()):
        ppx = step.line.column_px[77]
        assert made.rows(at.THESIS_PPX, "Scalars:scalars")[k] == [ppx]
        assert made.rows(at.THESIS_P, "Scalars:scalars")[k] == [(W - ppx) / W]
        expected = {
            "algorithm_1": ratio_depth(ppx, ratio_model_of(HEAD)),
            "algorithm_2": pixel_angle_depth(ppx, pixel_angle_model_of(HEAD)),
            "calibrated": step.profile.points[77, 0],
        }
        for name, depth in expected.items():
            shown = made.rows(f"{at.THESIS_DISTANCE}/{name}", "Scalars:scalars")[k]
            np.testing.assert_allclose(shown, [depth], rtol=1e-9, err_msg=name)


def test_thesis_row_without_line_shows_no_number(tmp_path: Path) -> None:
    made = recorded(tmp_path / "t.rrd", steps()[:1], row=3)
    assert np.isnan(made.rows(f"{at.THESIS_DISTANCE}/algorithm_1", "Scalars:scalars")[0]).all()


@pytest.mark.parametrize(("colour", "channel"), [("red", 2), ("green", 1), ("blue", 0)])
def test_thesis_pictures(tmp_path: Path, colour: str, channel: int) -> None:
    made = recorded(tmp_path / "t.rrd", steps(), thesis_every=3, overlay_colour=colour)
    pictures = {path: made.rows(path, "EncodedImage:blob") for path in at.THESIS_PICTURES}
    assert all(sorted(blobs) == [0, 3, 6] for blobs in pictures.values())
    lines = decode_image(bytes(pictures[at.THESIS_BINARY][3][0]), grey=True).image
    expected = np.zeros((H, W), np.uint8)
    expected[np.arange(H), np.rint(43.25 + 0.1 * ROWS).astype(int)] = 255
    np.testing.assert_array_equal(lines, expected)
    expected[:10] = 0  # rows without a line are not painted
    line = decode_image(bytes(pictures[at.THESIS_OVERLAY][3][0])).image[expected > 0].mean(axis=0)
    assert line[channel] > 180
    assert np.delete(line, channel).max() < 60


def test_the_row_must_be_in_the_image(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"view\.row = 120 .* 0 to 119"):
        opened(tmp_path / "x.rrd", row=H)


def test_settings_document_says_what_made_it(scan_rrd: Recorded) -> None:
    text = scan_rrd.rows(at.SETTINGS, "TextDocument:text", static=True)[None][0]
    assert "source: digital twin" in text
    assert "step_deg = 6.0" in text
    assert "| scanmap |" in text
    assert ["source: digital twin"] in scan_rrd.rows(at.LOG, "TextLog:text").values()


def test_blueprint_is_stored(scan_rrd: Recorded) -> None:
    assert [entry.application_id for entry in scan_rrd.reader.blueprints()] == [at.APPLICATION]


def small_grid() -> OccupancyGrid:
    """Three rows, two columns: the lowest row free, the highest occupied, on a floor 1 m below and leaning."""
    odds = np.array([[-2.0, -2.0], [0.0, 0.0], [3.5, 3.5]], np.float32)
    normal = np.array([0.02, 0.0, 1.0]) / np.hypot(0.02, 1.0)
    return OccupancyGrid(odds, 0.5, (-1.0, 2.0), Floor(np.append(normal, 1.0), 0.001, 100, "fitted"))


def test_grid_lies_on_the_floor_with_its_largest_y_on_top(tmp_path: Path) -> None:
    with opened(tmp_path / "g.rrd") as view:
        view.step(one_step(0))
        view.grid(small_grid())
    made = Recorded(tmp_path / "g.rrd")
    cells = np.frombuffer(bytes(made.rows(at.GRID, "GridMap:data")[0][0]), np.uint8).reshape(3, 2, 3)
    assert (cells[0] == 250).all()  # occupied
    assert (cells[1] == at.GROUND).all()  # unknown
    assert (cells[2] == (96, 104, 118)).all()  # free
    corner = np.ravel(made.rows(at.GRID, "GridMap:translation")[0])
    np.testing.assert_allclose(corner, [-1.0, 2.0, 0.0])
    plane = small_grid().floor.plane  # type: ignore[union-attr]
    in_world = transform(made.matrix(at.MAP, 0), corner)
    assert abs(in_world @ plane[:3] + plane[3]) < 1e-6


def test_finish_shows_the_cloud_and_fits_the_layout(tmp_path: Path) -> None:
    scan = Scan(HEAD.mount, H)
    with opened(tmp_path / "f.rrd", hide_above_m=0.1) as view:
        for step in steps():
            scan.add(step.profile, step.shot.bearing)
            view.step(step)
        view.finish(scan, small_grid())
    made = Recorded(tmp_path / "f.rrd")
    cloud = np.array(made.rows(at.CLOUD, "Points3D:positions", static=True)[None])
    points = scan.points[scan.valid]
    high = points[:, 2] > 0.1
    assert high.any()
    np.testing.assert_allclose(cloud, points[~high], atol=1e-6)
    above = np.array(made.rows(at.CLOUD_ABOVE, "Points3D:positions", static=True)[None])
    np.testing.assert_allclose(above, points[high], atol=1e-6)
    assert len(made.rows(at.CLOUD, "Points3D:colors", static=True)[None]) == len(cloud)
    assert made.rows(at.RESULT_GRID, "GridMap:data", static=True)
    assert made.rows(at.SCAN_STATE, "StateChange:state")[STEPS] == ["finished"]
    assert len(made.reader.blueprints()) >= 1


def test_finish_of_an_empty_scan(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with opened(tmp_path / "e.rrd") as view:
        view.finish(Scan(HEAD.mount, H), None)
    assert not caplog.records
    assert Recorded(tmp_path / "e.rrd").rows(at.SCAN_STATE, "StateChange:state")[0] == ["finished"]


def test_log_levels(tmp_path: Path) -> None:
    with opened(tmp_path / "l.rrd") as view:
        view.step(one_step(4))
        view.log("warning", "stage is late")
    made = Recorded(tmp_path / "l.rrd")
    assert made.rows(at.LOG, "TextLog:text")[4] == ["stage is late"]
    assert made.rows(at.LOG, "TextLog:level")[4] == ["WARN"]


# What goes wrong


def test_a_failing_view_warns_once_and_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = opened(tmp_path / "x.rrd")
    working = view._log_points

    def broken(step: Step) -> None:
        if step.shot.index < 3:
            raise RuntimeError("viewer fell over")
        working(step)

    monkeypatch.setattr(view, "_log_points", broken)
    for step in steps():
        view.step(step)
    view.close()
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "viewer fell over" in caplog.text
    assert sorted(Recorded(tmp_path / "x.rrd").rows(at.POINTS, "Points3D:positions")) == [3, 4, 5, 6]


def test_a_damaged_picture_is_left_out_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lost = one_step(1, image=b"no image", lost=slice(None))
    lost.line.reason[:] = Reason.DAMAGED
    lost.profile.reason[:] = Reason.DAMAGED
    made = recorded(
        tmp_path / "d.rrd", [one_step(0), lost._replace(fault="cannot be decoded"), one_step(2)], thesis_every=1
    )
    assert sorted(made.rows(at.IMAGE, "EncodedImage:blob")) == [0, 2]
    assert sorted(made.rows(at.THESIS_GREY, "EncodedImage:blob")) == [0, 2]
    assert made.rows(at.LOG, "TextLog:text")[1] == ["shot 1: cannot be decoded"]
    assert made.rows(at.LINE_STATE, "StateChange:state")[1] == ["damaged image"]
    assert not caplog.records


def test_a_full_disk_ends_the_view_in_good_order(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = opened(tmp_path / "full.rrd")
    view.step(one_step(0))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_000_000))
    for k in range(1, 20):
        view.step(one_step(k))
    view.grid(small_grid())
    view.close()
    assert "MB free" in caplog.text
    assert not view.alive
    shots = sorted(Recorded(tmp_path / "full.rrd").rows(at.HEAD, "Transform3D:mat3x3"))
    assert shots == list(range(len(shots)))
    assert 1 <= len(shots) <= 8


def test_a_file_that_was_not_written_to_its_end_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cut.rrd"
    view = opened(path)
    view.step(one_step(0))
    disconnect = view._recording.disconnect

    def cut() -> None:
        disconnect()
        path.write_bytes(path.read_bytes()[:-100])

    monkeypatch.setattr(view._recording, "disconnect", cut)
    view.close()
    assert "could not be written to its end" in caplog.text


def test_a_closing_that_hangs_is_left_behind(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    import rerun

    over, left = threading.Event(), []
    view = opened(tmp_path / "hang.rrd")
    real = view._recording.disconnect
    monkeypatch.setattr(view._recording, "disconnect", over.wait)
    monkeypatch.setattr("scanmap.view.recorder.CLOSE_TIMEOUT_S", 0.05)
    monkeypatch.setattr(rerun, "unregister_shutdown", lambda: left.append(True))
    view.close()
    assert left == [True]
    assert "could not be written" in caplog.text
    over.set()
    real()


@pytest.mark.parametrize("path", ["missing/x.rrd", "."])
def test_a_file_that_cannot_be_written(tmp_path: Path, path: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot be written .*--rrd"):
        opened(tmp_path / path)


def test_a_view_goes_somewhere() -> None:
    with pytest.raises(ConfigError, match="--rrd"):
        opened(None)


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server.getsockname()[1]


def test_a_port_in_use_is_said_before_the_scan(tmp_path: Path, taken_port: int) -> None:
    with pytest.raises(ConfigError, match=rf"port {taken_port} .*--live|port {taken_port} .*live_port"):
        opened(tmp_path / "x.rrd", live_port=taken_port)
    assert not (tmp_path / "x.rrd").exists()


def listening_addresses(port: int) -> set[str]:
    """Local addresses in state LISTEN on `port`, from the kernel's tables."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, number = local.split(":")
            if state == "0A" and int(number, 16) == port:
                found.add(address)
    return found


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the kernel's tables")
def test_a_live_view_serves_this_machine_only_and_the_file_is_whole(tmp_path: Path) -> None:
    port = viewer.free_port()
    with opened(tmp_path / "both.rrd", live_port=port) as view:
        for step in steps():
            view.step(step)
        assert listening_addresses(port) == {"0100007F"}
    assert sorted(Recorded(tmp_path / "both.rrd").rows(at.IMAGE, "EncodedImage:blob")) == list(range(STEPS))
    viewer.check_port(port)  # free again


def test_nothing_to_show(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--save"):
        show(tmp_path / "none.rrd")


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="there is always a display")
def test_no_display_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    path = tmp_path / "a.rrd"
    path.write_bytes(b"RRF2")
    with pytest.raises(ConfigError, match=r"no display .*--save F\.rrd"):
        show(path)
    with pytest.raises(ConfigError, match=r"no display .*9876"):
        show(9876)


def test_the_viewer_is_told_not_to_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.delenv("CI", raising=False)
    environment = viewer.viewer_environment()
    assert environment["CI"] == "true"
    assert "FORCE_RERUN_ANALYTICS" not in environment
    assert "CI" not in os.environ


def test_a_viewer_that_dies_is_an_error_with_its_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "rerun"
    program.write_text('#!/bin/sh\necho "$@" > "$0.args"\necho "no adapter" >&2\nexit 3\n', encoding="ascii")
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_binary", lambda: program)
    with pytest.raises(ConfigError, match=r"code 3\): no adapter"):
        viewer.start_viewer(["x.rrd"])
    assert (tmp_path / "rerun.args").read_text(encoding="ascii").split() == ["--bind", "127.0.0.1", "x.rrd"]


def test_importing_the_view_does_not_import_rerun() -> None:
    code = "import sys, scanmap.view; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# Geometry and pictures


@given(beta=st.floats(-30, 60), yaw=st.floats(-0.2, 0.2), pitch=st.floats(-0.2, 0.2), offset=st.floats(-0.05, 0.05))
def test_fan_lies_in_the_laser_plane(beta: float, yaw: float, pitch: float, offset: float) -> None:
    normal = np.array([np.sin(yaw), np.cos(yaw), np.sin(pitch)])
    document = {
        "image": {"width": W, "height": H},
        "head": {"baseline_m": 0.2, "beta_deg": beta, "alpha_deg": 30.0, "laser_plane": (*normal, offset)},
    }
    calibration = CalibrationFile.model_validate(document).build()
    fan = laser_fan(calibration, reach_m=1.5)
    plane = calibration.laser_plane
    np.testing.assert_allclose(fan.vertices @ plane[:3] + plane[3], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(fan.vertices[1:] - fan.vertices[0], axis=1), 1.5)
    assert fan.vertices[1, 2] > fan.vertices[0, 2] > fan.vertices[-1, 2]  # the first row looks up
    assert fan.triangles.max() == len(fan.vertices) - 1


@given(low=st.tuples(*[st.floats(-5, 0)] * 3), size=st.tuples(*[st.floats(0.05, 8)] * 3), bearing=st.floats(-7.0, 7.0))
def test_the_eye_sees_everything_from_behind_and_above(
    low: tuple[float, ...], size: tuple[float, ...], bearing: float
) -> None:
    corners = np.array([np.add(low, np.multiply(size, corner)) for corner in np.ndindex(2, 2, 2)])
    eye = eye_over(corners[0], corners[-1], bearing)
    gaze = np.subtract(eye.target, eye.position)
    assert gaze[2] < 0
    assert gaze[:2] @ [np.cos(bearing), np.sin(bearing)] > 0
    seen = corners - eye.position
    angle = np.arccos(seen @ gaze / np.linalg.norm(seen, axis=1) / np.linalg.norm(gaze))
    assert np.degrees(angle).max() < 60


@given(image=arrays(np.uint8, st.tuples(st.integers(4, 20), st.integers(4, 20))), factor=st.integers(1, 4))
def test_made_smaller_each_block_keeps_its_brightest_pixel(image: Any, factor: int) -> None:
    small = shrunk_lines(image, factor)
    assert small.shape == (image.shape[0] // factor, image.shape[1] // factor) == shrunk(image, factor).shape[:2]
    for r, c in np.ndindex(small.shape):
        block = image[r * factor : (r + 1) * factor, c * factor : (c + 1) * factor]
        assert small[r, c] == block.max()


@given(width=st.integers(16, 8000), limit=st.integers(0, 8000))
def test_shrink_factor_is_the_smallest_that_fits(width: int, limit: int) -> None:
    factor = shrink_factor(width, limit)
    if limit == 0:
        assert factor == 1
    else:
        assert width / factor <= limit
        assert factor == 1 or width / (factor - 1) > limit


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_overlay_made_smaller_still_shows_every_row(factor: int) -> None:
    grey = np.full((H, W), 250, np.uint8)
    column = np.where(ROWS % 12 < 6, 30.0 + ROWS, np.nan)
    picture = painted(grey, column, "green", factor)
    is_green = (picture == (0, 255, 0)).all(axis=2)
    assert picture.shape == (H // factor, W // factor, 3)
    rows = np.flatnonzero(np.isfinite(column))
    assert is_green[rows // factor, column[rows].astype(int) // factor].all()
    assert is_green.sum(axis=1).max() <= (1 if factor == 1 else 2 + factor)
    assert (picture[~is_green] == 250).all()


def test_a_wide_overlay_is_three_pixels_wide_and_nothing_else_changes() -> None:
    """In a pane half as wide as the picture a single pixel beside a saturated line is lost."""
    grey = np.full((H, W), 250, np.uint8)
    picture = painted(grey, np.full(H, 50.2), "red", 1, wide=True)
    expected = np.full((H, W, 3), 250, np.uint8)
    expected[:, 49:52] = (0, 0, 255)
    np.testing.assert_array_equal(picture, expected)


@pytest.mark.parametrize("shape", [(24, 40), (24, 40, 3)])
def test_jpeg_gives_the_picture_back(shape: tuple[int, ...]) -> None:
    image = np.full(shape, 90, np.uint8)
    image[:, 20] = (20, 200, 30) if len(shape) == 3 else 200
    back = decode_image(jpeg(image, 95).data, grey=len(shape) == 2).image
    assert np.abs(back.astype(int) - image).max() < 12


def test_heights_go_from_blue_to_red() -> None:
    colours = height_colours(np.array([-5.0, 0.0, 1.0, 2.0, 9.0]), 0.0, 2.0).astype(int)
    assert (colours[0] == colours[1]).all()
    assert (colours[3] == colours[4]).all()
    assert colours[0, 2] > colours[0, 0]
    assert colours[3, 0] > colours[3, 2]


# The viewer itself


def vulkan() -> bool:
    return any(Path("/usr/share/vulkan/icd.d").glob("*.json"))


@pytest.mark.slow
@pytest.mark.skipif(not vulkan(), reason="no Vulkan driver; install mesa-vulkan-drivers")
@pytest.mark.parametrize("tab", at.TABS)
def test_each_tab_can_be_drawn(tmp_path: Path, tab: str) -> None:
    import cv2

    from scanmap.view.picture import render

    scan = Scan(HEAD.mount, H)
    with opened(tmp_path / "r.rrd") as view:
        for step in steps():
            scan.add(step.profile, step.shot.bearing)
            view.step(step)
        view.finish(scan, small_grid())
    render(tmp_path / "r.rrd", tmp_path / "r.png", tab=tab, width=1200, height=800)
    picture = cv2.imread(str(tmp_path / "r.png"))
    assert picture is not None
    assert picture.shape == (800, 1200, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200


def test_boards_in_space_stand_where_they_were(tmp_path: Path) -> None:
    own, T = HEAD.intrinsics, HEAD.T_head_camera
    outline = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.2, 0.0], [0.0, 0.2, 0.0]])
    pose = np.eye(4)
    pose[:3, 3] = -0.1, -0.05, 0.6
    laser = np.array([[-0.02, 0.01 * k, 0.6] for k in range(5)])
    off = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
    picture = np.full((own.height, own.width, 3), 90, np.uint8)
    write_boards(tmp_path / "b.rrd", HEAD, outline, [pose], [laser], [off], [("one", picture)])
    made = Recorded(tmp_path / "b.rrd")
    np.testing.assert_allclose(made.matrix("head/camera", None), T, atol=1e-6)
    K = np.reshape(made.rows("head/camera/image", "Pinhole:image_from_camera", static=True)[None], (3, 3)).T
    np.testing.assert_allclose(K, own.matrix + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), rtol=1e-6)
    strip = np.reshape(made.rows("head/boards", "LineStrips3D:strips", static=True)[None][0], (5, 3))
    np.testing.assert_allclose(strip[:4], (outline + pose[:3, 3]) @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    points = np.reshape(made.rows("head/laser", "Points3D:positions", static=True)[None], (-1, 3))
    np.testing.assert_allclose(points, laser @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    colours = [c >> 8 for c in made.rows("head/laser", "Points3D:colors", static=True)[None]]
    assert colours[0] == 0x0072B2 and colours[2] == 0xD2D2D2 and colours[4] == 0xD55E00  # nearer, on it, farther
    assert made.rows("head/axis", "LineStrips3D:strips", static=True)
    assert made.rows("head/plane", "Mesh3D:vertex_positions", static=True)
