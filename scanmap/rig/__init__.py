"""The protocols a real head and the digital twin share: `Camera`, `Stage`, and `Rig`, the two together."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import NamedTuple, Protocol, runtime_checkable


class Frame(NamedTuple):
    """One picture as the camera sent it."""

    image: bytes  # encoded JPEG or PNG
    time: float  # [s] of exposure, on the monotonic clock of the rig


class Camera(Protocol):
    """Delivers encoded pictures."""

    @property
    def width(self) -> int:
        """Image width [px]."""
        ...

    @property
    def height(self) -> int:
        """Image height [px]."""
        ...

    def grab(self) -> Frame:
        """A picture whose exposure began after this call.

        Raises:
            CameraError: no picture came, or it is unusable.
        """
        ...

    def close(self) -> None:
        """Free the device; may be called twice."""
        ...


@runtime_checkable
class Streaming(Protocol):
    """A camera that sends all the time: continuous sweeps and live views take its pictures as they come."""

    def newest(self) -> Frame:
        """The newest picture that was not handed out yet, whenever it was exposed; `Frame.time` says when.

        Raises:
            CameraError: no picture came, or it is unusable.
        """
        ...


@runtime_checkable
class Exposing(Protocol):
    """A camera whose exposure can be changed while it runs."""

    def expose(self, exposure_us: float) -> None:
        """Expose so long from the next picture on [us].

        Raises:
            CameraError: it cannot.
        """
        ...


class Stage(Protocol):
    """Turns the head and switches the laser."""

    @property
    def laser_switchable(self) -> bool:
        """Whether software can switch the laser; False for one on batteries."""
        ...

    def move_to(self, bearing: float) -> float:
        """Turn to `bearing` [rad], wait for arrival, return the bearing the stage reports [rad].

        Raises:
            StageError: outside the limits, no answer, or not arrived.
        """
        ...

    def where(self) -> float:
        """The bearing the stage reports now [rad]."""
        ...

    def laser(self, on: bool) -> None:
        """Switch the laser; does nothing where it cannot be switched."""
        ...

    def close(self) -> None:
        """Laser off, motor free, port closed; may be called twice and never raises."""
        ...


@runtime_checkable
class Jogging(Protocol):
    """A stage that can be stopped in mid-way: an interruption of `jog` leaves the head where it is, its place kept."""

    def jog(self, bearing: float) -> float:
        """As `Stage.move_to`.

        Raises:
            StageError: outside the limits, no answer, or not arrived.
        """
        ...


@dataclass(frozen=True)
class Rig:
    """A camera and a stage on one head; a context manager that closes both, laser first."""

    camera: Camera
    stage: Stage
    name: str  # what users call it: `digital twin`, `/dev/ttyUSB0 + camera 0`
    is_twin: bool = False

    def __enter__(self) -> Rig:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Laser off and motor free, then the camera."""
        try:
            self.stage.close()
        finally:
            self.camera.close()
