"""What stands where in a recording: topics, joints, attachments, metadata."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Literal

from pydantic import BaseModel, Field

from scanmap.shot import Withdrawal

CALIBRATION_ATTACHMENT = "calibration.toml"
RIG_ATTACHMENT = "rig.toml"
START_METADATA = "scanmap"  # written first: versions, source, plan, start_ns
END_METADATA = "end"  # written last: reason, shots
METADATA_CRC = "crc32"  # the format guards messages and attachments by a CRC, but not metadata

# Details of a diagnostics status that takes shots back which stand before it, in this part or an earlier one.
WITHDRAWN_DETAIL, WITHDRAWN_WHY_DETAIL = "withdrawn_shots", "withdrawn_why"
WITHDRAWN_WORDS = {
    Withdrawal.PLACE: "the head may not have stood where they say",
    Withdrawal.LINE: "the laser was out",
}

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
JOINT_STATE = "sensor_msgs/msg/JointState"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"

TF_STATIC_TOPIC = "/tf_static"  # a name that every ROS tool takes for granted
DIGITAL_TWIN = "digital twin"  # `source` of everything that no real camera saw


class RecordingParams(BaseModel, frozen=True, extra="forbid"):
    """How scans are recorded, and where a bag that others recorded keeps things; `[recording]` in a rig's TOML."""

    image_topic: str = Field(
        "/camera/image/compressed", min_length=1, description="topic of the CompressedImage with the laser on"
    )
    off_topic: str = Field(
        "/camera/off/compressed", min_length=1, description="topic of the CompressedImage with the laser off"
    )
    camera_info_topic: str = Field("/camera/camera_info", min_length=1, description="topic of the CameraInfo")
    joint_topic: str = Field("/joint_states", min_length=1, description="topic of the JointState with the bearing")
    diagnostics_topic: str = Field("/diagnostics", min_length=1, description="topic of the DiagnosticArray")
    joint: str = Field("head", min_length=1, description="joint with the reported bearing")
    commanded_joint: str = Field(
        "head_commanded", min_length=1, description="joint with the commanded bearing; may be absent"
    )
    max_gap_s: float = Field(0.5, gt=0, le=60, description="longest gap between two bearings to interpolate across [s]")
    withdrawn: Literal["leave-out", "keep-unlit", "keep"] = Field(
        "leave-out",
        description="replay, of shots that the sweep took back: none; those with the laser out; also those whose "
        "bearing is doubtful",
    )
    min_free_mb: float = Field(200.0, ge=0, description="a scan stops before the disk has less free than this [MB]")
    fsync_s: float = Field(1.0, ge=0, le=60, description="force what is recorded to the disk at most this often [s]")


def metadata_crc(metadata: Mapping[str, str]) -> str:
    """CRC-32 of the other entries of a metadata record, as it stands beside them."""
    rest = {key: value for key, value in metadata.items() if key != METADATA_CRC}
    return f"{zlib.crc32(json.dumps(rest, sort_keys=True).encode()):08x}"
