"""The standard ROS 2 messages of a recording, to and from CDR."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.recording.definitions import DEFINITIONS
from scanmap.recording.layout import CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTIC_ARRAY, JOINT_STATE, TF_MESSAGE
from scanmap.shot import image_format

Array = NDArray[np.float64]

CAMERA_FRAME = "camera"
SECOND_NS = 1_000_000_000


class MalformedMessageError(Exception):
    """A message's bytes are not what its type says."""


class StampedImage(NamedTuple):
    """A CompressedImage."""

    stamp_ns: int
    image: bytes


class StampedJoints(NamedTuple):
    """A JointState: positions [rad] by joint."""

    stamp_ns: int
    positions: dict[str, float]


class Fault(NamedTuple):
    """One status of a DiagnosticArray."""

    stamp_ns: int
    level: int  # 0 ok, 1 warning, 2 error
    part: str
    message: str
    details: Mapping[str, str] = MappingProxyType({})


@cache
def typestore() -> Any:
    """What rosbags makes of the message definitions."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    for name, fields in DEFINITIONS.items():
        store.register(get_types_from_msg(fields, name))
    return store


def definition(message_type: str) -> bytes:
    """Text of a message definition, as an MCAP schema of encoding `ros2msg` holds it."""
    text, _ = typestore().generate_msgdef(message_type, ros_version=2)
    return bytes(text, "utf-8")


def compressed_image(stamp_ns: int, image: bytes) -> bytes:
    """CDR of a CompressedImage that holds the encoded image untouched."""
    return _encode(
        COMPRESSED_IMAGE,
        header=_header(stamp_ns, CAMERA_FRAME),
        format=image_format(image),
        data=np.frombuffer(image, np.uint8),
    )


def joint_state(stamp_ns: int, positions: Mapping[str, float]) -> bytes:
    """CDR of a JointState; positions [rad] by joint, float64 as they are."""
    nothing = np.empty(0)
    return _encode(
        JOINT_STATE,
        header=_header(stamp_ns, ""),
        name=list(positions),
        position=np.array(list(positions.values()), np.float64),
        velocity=nothing,
        effort=nothing,
    )


def camera_info(stamp_ns: int, calibration: Calibration) -> bytes:
    """CDR of the CameraInfo of a calibration (plumb_bob, not rectified)."""
    own = calibration.intrinsics
    region = _type("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _encode(
        CAMERA_INFO,
        header=_header(stamp_ns, CAMERA_FRAME),
        height=own.height,
        width=own.width,
        distortion_model="plumb_bob",
        d=np.array(own.distortion),
        k=own.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([own.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def static_transforms(stamp_ns: int, calibration: Calibration, joint: str) -> bytes:
    """CDR of the TFMessage with everything on the head that does not turn.

    `<joint>_base` stands in the world, `<joint>_axis` carries `head` and `camera`; what joins the two is the
    joint, a rotation about z by its position, and therefore no static transform.
    """
    links = (
        ("world", f"{joint}_base", np.eye(4)),
        (f"{joint}_axis", "head", calibration.mount.T_axis_head()),
        ("head", CAMERA_FRAME, calibration.T_head_camera),
    )
    return _encode(TF_MESSAGE, transforms=[_transform(stamp_ns, *link) for link in links])


def diagnostics(fault: Fault) -> bytes:
    """CDR of a DiagnosticArray with one status."""
    pair = _type("diagnostic_msgs/msg/KeyValue")
    status = _type("diagnostic_msgs/msg/DiagnosticStatus")(
        level=fault.level,
        name=fault.part,
        message=fault.message,
        hardware_id="scanmap",
        values=[pair(key=key, value=value) for key, value in fault.details.items()],
    )
    return _encode(DIAGNOSTIC_ARRAY, header=_header(fault.stamp_ns, ""), status=[status])


def read_image(data: memoryview) -> StampedImage:
    """Parse a CompressedImage. Raises MalformedMessageError."""
    message = _decode(data, COMPRESSED_IMAGE)
    return StampedImage(_stamp_ns(message), message.data.tobytes())


def read_joints(data: memoryview) -> StampedJoints:
    """Parse a JointState. Raises MalformedMessageError."""
    message = _decode(data, JOINT_STATE)
    # A joint that only reports its speed or effort has no position.
    return StampedJoints(_stamp_ns(message), dict(zip(message.name, message.position.tolist(), strict=False)))


def read_faults(data: memoryview) -> list[Fault]:
    """Parse a DiagnosticArray. Raises MalformedMessageError."""
    message = _decode(data, DIAGNOSTIC_ARRAY)
    stamp = _stamp_ns(message)
    return [
        Fault(stamp, status.level, status.name, status.message, {pair.key: pair.value for pair in status.values})
        for status in message.status
    ]


def _type(name: str) -> Any:
    return typestore().types[name]


def _encode(message_type: str, **fields: object) -> bytes:
    return bytes(typestore().serialize_cdr(_type(message_type)(**fields), message_type))


def _decode(data: memoryview, message_type: str) -> Any:
    try:
        return typestore().deserialize_cdr(data, message_type)
    except Exception as error:  # whatever the codec stumbles over: struct, index, unicode, assertion
        raise MalformedMessageError(f"not a {message_type}: {error}") from error


def _header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    stamp = _type("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
    return _type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def _transform(stamp_ns: int, parent: str, child: str, T: Array) -> Any:
    x, y, z, w = quaternion(T[:3, :3])
    return _type("geometry_msgs/msg/TransformStamped")(
        header=_header(stamp_ns, parent),
        child_frame_id=child,
        transform=_type("geometry_msgs/msg/Transform")(
            translation=_type("geometry_msgs/msg/Vector3")(*(float(v) for v in T[:3, 3])),
            rotation=_type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w),
        ),
    )


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a (3, 3) rotation.

    Source: eigenvector of the largest eigenvalue of K (Bar-Itzhack 2000), which needs no case distinction.
    """
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    x, y, z, w = (q if q[3] >= 0 else -q).tolist()
    return x, y, z, w
