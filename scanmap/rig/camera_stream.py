"""A camera that sends all the time: always its newest picture, and for a shot one exposed after the head stopped.

A thread takes every picture as it comes, so that none waits in a buffer and grows old. Which one belongs to a
shot is decided by time stamps, not by throwing a number of pictures away.
"""

from __future__ import annotations

import logging
import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

from scanmap.errors import CameraError
from scanmap.rig import Frame
from scanmap.rig.camera import CameraParams
from scanmap.rig.camera_checks import Size, check_header, fingerprint, is_black
from scanmap.shot import Image, encode_png

OPENING_S = 8.0  # a webcam may take this long to its first picture
REOPEN_S = 0.5  # between two attempts to get a lost camera back
WARM_UP_S, AUTOMATIC_WARM_UP_S = 0.5, 1.5  # pictures of a camera that has just started are dark or green
FOLLOW_S = 0.6  # a webcam shows a new exposure some pictures later
LEAVE_S = 2.0  # how long a thread may take to notice that it is to end
PERIODS = 15  # pictures whose distance in time is remembered
BLACK_TRIES = 2  # a black picture among others is a slip of the camera: the next ones are looked at first
BLACK_SHOTS = 10  # so many in a row are no dark corner of the room any more

logger = logging.getLogger(__name__)


class Picture(NamedTuple):
    """One picture on its way from a camera."""

    data: bytes | Image  # as sent, or (H, W, 3) BGR where the camera does not encode
    stamp: float  # [s] on the monotonic clock: the device's own stamp, or when it arrived


class PictureSource(Protocol):
    """Where pictures come from; used by one thread at a time."""

    @property
    def name(self) -> str:
        """What users call it."""
        ...

    def open(self) -> None:
        """Connect; may be called again after a fault. Raises CameraError."""
        ...

    def read(self) -> Picture:
        """Wait for the next picture. Raises CameraError when the camera is lost."""
        ...

    def close(self) -> None:
        """Disconnect; never raises, may be called twice."""
        ...


@runtime_checkable
class ExposingSource(Protocol):
    """A source whose exposure can be set."""

    def expose(self, exposure_us: float) -> None:
        """Expose so long from now on [us]; called by the thread that reads."""
        ...


class StreamCamera:
    """A camera behind a thread. Implements `scanmap.rig.Camera` and `scanmap.rig.Streaming`."""

    def __init__(
        self, source: PictureSource, params: CameraParams, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Open the source and wait for its first usable picture.

        Raises:
            CameraError: it cannot be opened, or sends nothing usable in time.
        """
        self._source = source
        self._params = params
        self._clock = clock
        self._news = threading.Condition()
        self._newest: Picture | None = None
        self._count = 0  # pictures that came so far
        self._taken = 0  # of these, the last one handed out
        self._fault: CameraError | None = None
        self._leaving = False
        self._stamps: deque[float] = deque(maxlen=PERIODS)
        self._last_print: int | None = None
        self._black_shots = 0
        self._size: Size | None = None
        self._wanted_us: float | None = None  # an exposure that the thread is to set
        self._steady_from = -math.inf  # [s] no picture exposed before is good for a shot
        self._thread = threading.Thread(target=self._read_on, name=f"camera {source.name}", daemon=True)
        source.open()
        self._thread.start()
        try:
            self._size = self._first_size()
            if params.kind == "device":
                self._steady_from = clock() + (WARM_UP_S if params.exposure_us else AUTOMATIC_WARM_UP_S)
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """What users call it."""
        return self._source.name

    @property
    def width(self) -> int:
        """Image width [px]."""
        return self._size.width if self._size else 0

    @property
    def height(self) -> int:
        """Image height [px]."""
        return self._size.height if self._size else 0

    @property
    def period_s(self) -> float:
        """Seconds from one picture to the next, median of the last ones; 0 before there are two."""
        with self._news:
            stamps = list(self._stamps)
        return statistics.median(b - a for a, b in pairwise(stamps)) if len(stamps) > 1 else 0.0

    @property
    def count(self) -> int:
        """Pictures the camera has sent."""
        return self._count

    def grab(self) -> Frame:
        """A picture whose exposure began after this call, decoded once to see that it is whole.

        Raises:
            CameraError: none came in time, or it is cut, damaged, of another size, black, or the old one again.
        """
        asked = max(self._clock(), self._steady_from)
        latency = self._params.latency
        # The latency counts from the middle of the exposure, which lasts a period at most.
        exposure_s = (self._params.exposure_us or 1e6 * (self.period_s or 1 / 30)) * 1e-6
        after = asked + latency + 0.5 * exposure_s
        deadline = asked + self._params.timeout_s + max(0.0, latency)
        for attempt in range(BLACK_TRIES + 1):
            data, stamp = self._fresh(after, deadline)
            if not is_black(data):
                self._black_shots = 0
                return Frame(data, stamp - latency)
            if attempt < BLACK_TRIES:
                logger.debug("%s sent a black picture", self.name)
        self._black_shots += 1
        if self._black_shots >= BLACK_SHOTS:
            raise CameraError(
                f"camera {self.name} sent black pictures for {self._black_shots} shots: take its lens cap off, or set "
                "camera.exposure_us higher"
            )
        return Frame(data, stamp - latency)

    def expose(self, exposure_us: float) -> None:
        """Expose so long from now on [us]; the next shot waits until the camera has followed.

        Raises:
            CameraError: this source cannot.
        """
        if not isinstance(self._source, ExposingSource) or self._params.kind != "device":
            raise CameraError(
                f"the exposure of camera {self.name} cannot be set from here: leave sweep.exposures_us empty"
            )
        with self._news:
            self._params = self._params.model_copy(update={"exposure_us": exposure_us})
            self._wanted_us = exposure_us
            self._steady_from = self._clock() + FOLLOW_S

    def newest(self) -> Frame:
        """The newest picture that was not handed out yet; only its header is looked at.

        Raises:
            CameraError: none came in time, or it is cut or of another size.
        """
        picture = self._wait(lambda _: True, self._clock() + self._params.timeout_s)
        data = _encoded(picture)
        check_header(data, self._size)
        return Frame(data, picture.stamp - self._params.latency)

    def close(self) -> None:
        """Free the device; may be called twice."""
        with self._news:
            self._leaving = True
            self._news.notify_all()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(LEAVE_S)

    def _fresh(self, after: float, deadline: float) -> tuple[bytes, float]:
        """Bytes and stamp of a picture stamped later than `after` that differs from the last one."""
        frozen = False
        while True:
            try:
                picture = self._wait(lambda stamp: stamp > after, deadline)
            except CameraError as error:
                if not frozen or self._fault is not None:
                    raise
                raise CameraError(
                    f"camera {self.name} is frozen, it sends the same picture again and again: unplug it and plug it "
                    "in, or restart its app"
                ) from error
            data = _encoded(picture)
            check_header(data, self._size)
            mark = fingerprint(data)
            # Sensor noise makes every picture another one, except where all is clipped to black.
            if mark != self._last_print or is_black(data):
                self._last_print = mark
                return data, picture.stamp
            frozen = True

    def _wait(self, wanted: Callable[[float], bool], deadline: float) -> Picture:
        """The newest picture whose stamp is wanted."""
        came = self._count
        with self._news:
            while True:
                left = deadline - self._clock()
                if left <= 0 or self._leaving:
                    break
                if self._newest is not None and self._count > self._taken and wanted(self._newest.stamp):
                    self._taken = self._count
                    return self._newest
                self._news.wait(left)
            raise self._nothing(self._count - came)

    def _nothing(self, came: int) -> CameraError:
        if self._leaving:
            return CameraError(f"camera {self.name} is closed")
        if self._fault is not None:
            return self._fault
        if came:
            return CameraError(
                f"camera {self.name} sends only old pictures, {came} of them: they wait too long on their way; measure "
                "camera.latency_s with scanmap calibrate latency"
            )
        return CameraError(
            f"camera {self.name} sent no picture for {self._params.timeout_s:g} s: check its cable; another program "
            "may hold it; `scanmap doctor` lists what is there"
        )

    def _first_size(self) -> Size:
        deadline = self._clock() + max(OPENING_S, self._params.timeout_s)
        fault: CameraError | None = None
        while True:
            try:
                size = check_header(_encoded(self._wait(lambda _: True, deadline)), None)
            except CameraError as error:
                if self._clock() >= deadline:
                    raise (fault or error) from None
                fault = error
                continue
            wanted = Size(self._params.width or size.width, self._params.height or size.height)
            if size != wanted:
                logger.warning("camera %s: asked for %s, it sends %s", self.name, wanted, size)
            return size

    def _read_on(self) -> None:
        """The thread: keep the newest picture; get a lost camera back."""
        is_open = True
        while not self._leaving:
            try:
                if not is_open:
                    self._source.open()
                    is_open = True
                if self._wanted_us is not None and isinstance(self._source, ExposingSource):
                    wanted, self._wanted_us = self._wanted_us, None
                    self._source.expose(wanted)
                picture = self._source.read()
            except Exception as raised:  # a driver's own fault too is the camera's, and no thread may die in silence
                error = raised if isinstance(raised, CameraError) else CameraError(f"camera {self.name}: {raised!r}")
                self._source.close()
                is_open = False
                with self._news:
                    if self._fault is None and not self._leaving:
                        logger.warning("%s", error)
                    self._fault = error
                    if not self._leaving:
                        self._news.wait(REOPEN_S)
                continue
            with self._news:
                self._newest, self._fault = picture, None
                self._count += 1
                self._stamps.append(picture.stamp)
                self._news.notify_all()
        self._source.close()


def _encoded(picture: Picture) -> bytes:
    return picture.data if isinstance(picture.data, bytes) else encode_png(picture.data)
