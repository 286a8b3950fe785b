"""A calibration from boards in space: the camera, every board where it was, the laser's points and their distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import ConfigError
from scanmap.geometry import inverse, transform
from scanmap.shot import Image
from scanmap.view import entities as at
from scanmap.view.pictures import jpeg
from scanmap.view.scene import HALF_PIXEL, laser_fan

if TYPE_CHECKING:
    import rerun as rr

Array = NDArray[np.float64]

# Blue is nearer than the plane, vermilion farther, grey on it: told apart by all eyes.
_NEAR, _ON, _FAR = np.array([0, 114, 178]), np.array([210, 210, 210]), np.array([213, 94, 0])


def write_boards(
    path: Path,
    calibration: Calibration,
    outline: Array,
    poses: Sequence[Array],
    points: Sequence[Array],
    off_m: Sequence[Array],
    pictures: Sequence[tuple[str, Image]],
) -> None:
    """Write an .rrd of a calibration from boards, in the head frame.

    Args:
        path: file to write.
        calibration: the result.
        outline: (4, 3) of a board in its own frame [m].
        poses: T_camera_board (4, 4) of each board.
        points: (N, 3) of the laser on each board, camera frame [m]; empty where there is no laser.
        off_m: (N,) their distances from the plane [m].
        pictures: name and picture; the first is shown in the camera.

    Raises:
        ConfigError: the file cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    recording = rr.RecordingStream(f"{at.APPLICATION}-boards")
    try:
        path.open("wb").close()
        recording.save(path, default_blueprint=rrb.Blueprint(_layout(calibration, poses), collapse_panels=True))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written ({error.strerror}); choose another path for --rrd") from error
    recording.log("head", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_camera(recording, calibration, [picture for _, picture in pictures[:1]])
    quads = [transform(calibration.T_head_camera @ pose, np.vstack([outline, outline[:1]])) for pose in poses]
    recording.log(
        "head/boards", rr.LineStrips3D(quads, colors=[120, 160, 120], radii=rr.Radius.ui_points(1.0)), static=True
    )
    if "axis" not in calibration.meta.get("uncalibrated", ()):
        reach = 1.2 * max(float(np.abs(np.concatenate(quads)[:, 2]).max()), 0.1)
        ends = np.array([[0.0, 0.0, -reach], [0.0, 0.0, reach]])
        strip = transform(inverse(calibration.mount.T_axis_head()), ends)
        recording.log(
            "head/axis",
            rr.LineStrips3D([strip], colors=[230, 159, 0], radii=rr.Radius.ui_points(2.0), labels="axis"),
            static=True,
        )
    if points:
        _log_laser(recording, calibration, np.concatenate(list(points)), np.concatenate(list(off_m)))
    recording.flush()
    recording.disconnect()


def _log_camera(recording: rr.RecordingStream, calibration: Calibration, pictures: Sequence[Image]) -> None:
    """The camera where it stands in the head, with what it saw."""
    import rerun as rr

    own, T = calibration.intrinsics, calibration.T_head_camera
    recording.log("head/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
    pinhole = rr.Pinhole(
        image_from_camera=own.matrix + HALF_PIXEL, resolution=[own.width, own.height], image_plane_distance=0.15,
        camera_xyz=rr.ViewCoordinates.RDF,
    )  # fmt: skip
    recording.log("head/camera/image", pinhole, static=True)
    for picture in pictures:
        sent = jpeg(picture, 80)
        recording.log("head/camera/image", rr.EncodedImage(contents=sent.data, media_type=sent.media_type), static=True)


def _log_laser(recording: rr.RecordingStream, calibration: Calibration, points: Array, off_m: Array) -> None:
    """The laser's points (N, 3) [m] of the camera frame by their distances (N,) from the plane, and the plane."""
    import rerun as rr

    cloud = transform(calibration.T_head_camera, points)
    colours = colours_by_distance(off_m, float(np.percentile(np.abs(off_m), 95)))
    recording.log("head/laser", rr.Points3D(cloud, colors=colours, radii=rr.Radius.ui_points(1.5)), static=True)
    fan = laser_fan(calibration, 1.1 * float(np.linalg.norm(cloud, axis=1).max()))
    plane = rr.Mesh3D(
        vertex_positions=fan.vertices, triangle_indices=fan.triangles, albedo_factor=[255, 30, 30, 40]
    )  # fmt: skip
    recording.log("head/plane", plane, static=True)


def colours_by_distance(off: Array, limit: float) -> NDArray[np.uint8]:
    """RGB (N, 3) by signed distance from a plane, full colour at `limit` in the same unit."""
    share = np.clip(off / max(limit, 1e-9), -1.0, 1.0)[:, None]
    mixed = np.where(share < 0, _ON + (_ON - _NEAR) * share, _ON + (_FAR - _ON) * share)
    return np.asarray(np.rint(mixed), np.uint8)


def _layout(calibration: Calibration, poses: Sequence[Array]) -> object:
    import rerun.blueprint as rrb

    T = calibration.T_head_camera
    middle = transform(T, np.mean([pose[:3, 3] for pose in poses], axis=0))
    away = float(np.linalg.norm(middle - T[:3, 3]))
    eye = middle + away * np.array([-1.4, 1.0, 0.9])
    return rrb.Spatial3DView(
        origin="/head",
        name="Boards",
        background=[*at.GROUND, 255],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
