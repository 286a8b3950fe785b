"""`Recorder`: one scan into one MCAP file, every shot safe as soon as it is written."""

from __future__ import annotations

import json
import platform
import shlex
import shutil
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Literal

import cv2
import numpy as np

import scanmap
from scanmap.calibration import Calibration
from scanmap.errors import RecordingError
from scanmap.recording import layout, messages
from scanmap.recording.layout import RecordingParams
from scanmap.recording.messages import SECOND_NS, Fault
from scanmap.recording.shot_file import ShotFile
from scanmap.shot import Shot, Withdrawal

LEVELS = {"ok": 0, "warning": 1, "error": 2}
MB = 1e6

# Late subscribers must still get the static transforms; rosbag2 keeps that in the channel's metadata.
LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n"
    "    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n"
    "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)


def whole_ns(seconds: float) -> float:
    """The time [s] a recording gives back for `seconds`: message stamps count whole nanoseconds."""
    return round(seconds * SECOND_NS) / SECOND_NS


class Recorder:
    """Writes shots as they come; a context manager.

    Raises RecordingError when the file exists, cannot be written, or the disk is nearly full; what was
    written before stays readable. Images are kept as they are, byte for byte; bearings as float64; times
    to the nanosecond, which is why `write` gives back the shot that a replay will see.

    Args:
        path: the .mcap file; its folder must exist.
        calibration: of the head, kept as an attachment, CameraInfo and static transforms.
        source: the rig's name, or `digital twin`.
        rig_toml: the effective configuration, kept as an attachment.
        plan: what the sweep set out to do; kept as JSON.
        metadata: anything else worth keeping (versions of firmware and libraries).
        expected_shots: from the plan; lets a disk that is too small be noticed at the first shot. 0 = unknown.
        overwrite: replace a file that exists.
        start_ns: wall clock at the time 0 of the shots [ns since 1970]; now, if left out. The parts of one scan
            have it in common.
        begun_ns: when this file begins, where that is later: a part that continues another.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        calibration: Calibration,
        source: str,
        rig_toml: str = "",
        plan: Mapping[str, object] | None = None,
        metadata: Mapping[str, str] | None = None,
        expected_shots: int = 0,
        overwrite: bool = False,
        start_ns: int | None = None,
        begun_ns: int | None = None,
        params: RecordingParams | None = None,
    ) -> None:
        self.path = Path(path)
        self.params = params or RecordingParams()
        self.shots = 0
        self.closed = False
        self._calibration = calibration
        self._expected_shots = expected_shots
        self._start_ns = time.time_ns() if start_ns is None else start_ns
        self._begun_ns = begun_ns or self._start_ns
        self._schemas: dict[str, int] = {}
        self._lock = threading.Lock()
        self._check_disk(0)
        self._file = ShotFile(self.path, overwrite, self.params.fsync_s)
        self._begin(source, rig_toml, dict(plan or {}), dict(metadata or {}))

    @property
    def size_bytes(self) -> int:
        """Bytes in the file."""
        return self._file.tell()

    def write(self, shot: Shot) -> Shot:
        """Add a shot; it is in the operating system's hands when this returns, on the disk a second later.

        Returns:
            The shot as every replay will give it: the same but for a time in whole nanoseconds.

        Raises:
            RecordingError: disk full, file system error, or the recorder is closed.
        """
        offset_ns = round(shot.time * SECOND_NS)
        stamp = self._start_ns + offset_ns
        p = self.params
        positions = {p.joint: shot.bearing, p.commanded_joint: shot.bearing_commanded}
        # The bearing and the laser-off image come first: a reader that meets the image has the whole shot.
        parts = [(p.joint_topic, messages.joint_state(stamp, positions))]
        if shot.background is not None:
            parts.append((p.off_topic, messages.compressed_image(stamp, shot.background)))
        parts.append((p.camera_info_topic, messages.camera_info(stamp, self._calibration)))
        parts.append((p.image_topic, messages.compressed_image(stamp, shot.image)))
        self._write_chunk(stamp, parts, shot.index)
        self.shots += 1
        self._check_disk(self.size_bytes * max(self._expected_shots - 1, 0) if self.shots == 1 else 0)
        return replace(shot, time=offset_ns / SECOND_NS)

    def fault(
        self,
        message: str,
        *,
        part: str,
        seconds: float,
        level: Literal["ok", "warning", "error"] = "warning",
        details: Mapping[str, str] | None = None,
    ) -> None:
        """Note a fault or a retry on the diagnostics topic.

        Args:
            message: one line.
            part: whose fault it is: `camera`, `stage`, `laser`.
            seconds: when, on the clock of `Shot.time` [s].
        """
        stamp = self._start_ns + round(seconds * SECOND_NS)
        data = messages.diagnostics(Fault(stamp, LEVELS[level], part, message, details or {}))
        self._write_chunk(stamp, [(self.params.diagnostics_topic, data)], 0)

    def withdraw(self, indices: Collection[int], why: Withdrawal, *, seconds: float) -> None:
        """Take back shots written so far: no replay shows them, unless asked to; they stay in the file.

        Args:
            indices: of the shots; those written later under the same index count again.
            seconds: when, on the clock of `Shot.time` [s].
        """
        numbers = " ".join(map(str, sorted(indices)))
        self.fault(
            f"{len(indices)} shots withdrawn: {layout.WITHDRAWN_WORDS[why]}",
            part="sweep",
            seconds=seconds,
            level="error",
            details={layout.WITHDRAWN_DETAIL: numbers, layout.WITHDRAWN_WHY_DETAIL: why.value},
        )

    def close(self, reason: str = "finished") -> None:
        """End the file: why (`finished`, `interrupted`, `error: ...`), how many shots, index. May be called twice.

        Raises:
            RecordingError: the end could not be written; the shots stay readable.
        """
        with self._lock:
            if self.closed:
                return
            self.closed = True
            try:
                if not self._file.failed:
                    self._note(layout.END_METADATA, {"reason": reason, "shots": str(self.shots)})
                    self._writer.finish()
                    self._file.flush()
                    self._file.sync()
            except OSError as error:
                raise self._cannot_write(error) from error
            finally:
                self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        stopped = isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit)
        with suppress(RecordingError):  # what went wrong first is what the user must hear of
            self.close("interrupted" if stopped else f"error: {error}")

    def _begin(self, source: str, rig_toml: str, plan: dict[str, object], metadata: dict[str, str]) -> None:
        from mcap.writer import CompressionType, Writer

        p = self.params
        library = f"scanmap {scanmap.__version__}"
        about = _versions() | {"source": source, "start_ns": str(self._start_ns)}
        if plan:
            about["plan"] = json.dumps(plan)
        # A chunk ends where a shot ends, never by size.
        self._writer = Writer(self._file, chunk_size=1 << 40, compression=CompressionType.NONE)
        try:
            self._writer.start(profile="ros2", library=library)
            self._note(layout.START_METADATA, metadata | about)
            self._attach(layout.CALIBRATION_ATTACHMENT, self._calibration.dumps())
            if rig_toml:
                self._attach(layout.RIG_ATTACHMENT, rig_toml)
            self._channels = {
                p.image_topic: self._channel(p.image_topic, layout.COMPRESSED_IMAGE),
                p.off_topic: self._channel(p.off_topic, layout.COMPRESSED_IMAGE),
                p.joint_topic: self._channel(p.joint_topic, layout.JOINT_STATE),
                p.camera_info_topic: self._channel(p.camera_info_topic, layout.CAMERA_INFO),
                p.diagnostics_topic: self._channel(p.diagnostics_topic, layout.DIAGNOSTIC_ARRAY),
                layout.TF_STATIC_TOPIC: self._channel(layout.TF_STATIC_TOPIC, layout.TF_MESSAGE, LATCHED),
            }
        except OSError as error:
            self._file.close()
            raise self._cannot_write(error) from error
        transforms = messages.static_transforms(self._begun_ns, self._calibration, p.joint)
        self._write_chunk(self._begun_ns, [(layout.TF_STATIC_TOPIC, transforms)], 0)

    def _note(self, name: str, data: dict[str, str]) -> None:
        self._writer.add_metadata(name, data | {layout.METADATA_CRC: layout.metadata_crc(data)})

    def _attach(self, name: str, text: str) -> None:
        self._writer.add_attachment(self._start_ns, self._start_ns, name, "application/toml", text.encode())

    def _channel(self, topic: str, message_type: str, qos: str = "") -> int:
        if message_type not in self._schemas:
            text = messages.definition(message_type)
            self._schemas[message_type] = int(self._writer.register_schema(message_type, "ros2msg", text))
        return int(
            self._writer.register_channel(topic, "cdr", self._schemas[message_type], {"offered_qos_profiles": qos})
        )

    def _write_chunk(self, stamp: int, parts: list[tuple[str, bytes]], sequence: int) -> None:
        with self._lock:
            if self.closed or self._file.failed:
                raise RecordingError(f"recording {self.path} is closed")
            try:
                for topic, data in parts:
                    self._writer.add_message(self._channels[topic], stamp, data, stamp, sequence)
                self._writer.flush()
                self._file.sync_when_due()
            except OSError as error:
                raise self._cannot_write(error) from error

    def _check_disk(self, needed_bytes: int) -> None:
        try:
            free = shutil.disk_usage(self.path.parent).free
        except OSError as error:
            raise RecordingError(f"cannot record to {self.path}: {error.strerror}") from error
        if free - needed_bytes < self.params.min_free_mb * MB:
            still = f" and {needed_bytes / MB:.0f} MB still to come" if needed_bytes else ""
            raise RecordingError(
                f"disk of {self.path} has {free / MB:.0f} MB free{still}, recording.min_free_mb is "
                f"{self.params.min_free_mb:g}; {self.shots} shots are recorded and readable: free some space, "
                "record elsewhere (--record F.mcap), or scan with --no-record"
            )

    def _cannot_write(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"recording {self.path} stopped after {self.shots} shots: {error.strerror or error}; they are readable: "
            f"scanmap replay {shlex.quote(str(self.path))}"
        )


def _versions() -> dict[str, str]:
    """Of what makes a point out of a picture."""
    return {
        "scanmap_version": scanmap.__version__,
        "python_version": platform.python_version(),
        "numpy_version": np.__version__,
        "opencv_version": cv2.__version__,
        "simplejpeg_version": version("simplejpeg"),
    }
