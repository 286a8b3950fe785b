"""The file under a recording: every chunk whole or not there, and on the disk within a second."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from scanmap.errors import RecordingError


class ShotFile:
    """The stream under the MCAP writer: keeps what belongs to a chunk together, never leaves half of one.

    A plain buffered file would keep the rest of a chunk after a full disk, and fail on it again at close.
    """

    def __init__(self, path: Path, overwrite: bool, fsync_s: float) -> None:
        self.failed = False
        self._fsync_s = fsync_s
        self._parts: list[bytes] = []
        self._length = 0  # bytes on file and in _parts
        self._safe = 0  # bytes on file that end with a whole record
        self._synced = time.monotonic()
        try:
            self._raw: Any = path.open("wb" if overwrite else "xb", buffering=0)
        except FileExistsError as error:
            raise RecordingError(
                f"recording {path} exists already; choose another name (--record F.mcap) or move it away"
            ) from error
        except OSError as error:
            raise RecordingError(f"recording {path} cannot be written: {error.strerror}") from error

    def write(self, data: bytes) -> int:
        self._parts.append(data)
        self._length += len(data)
        return len(data)

    def tell(self) -> int:
        return self._length

    def flush(self) -> None:
        """Hand everything to the operating system; on failure cut the file back to its last whole chunk."""
        data = memoryview(b"".join(self._parts))
        self._parts.clear()
        try:
            while data:
                data = data[self._raw.write(data) :]
        except OSError:
            self.failed = True
            self._raw.truncate(self._safe)
            raise
        self._safe = self._length

    def sync_when_due(self) -> None:
        if time.monotonic() - self._synced >= self._fsync_s:
            self.sync()

    def sync(self) -> None:
        os.fsync(self._raw.fileno())
        self._synced = time.monotonic()

    def close(self) -> None:
        self._raw.close()
