"""A camera whose pictures arrive late, as every real one's do: exposed now, stamped a while later."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from scanmap.errors import CameraError
from scanmap.rig import Camera, Exposing, Frame


class DelayedCamera:
    """A camera behind a delay. Implements `scanmap.rig.Camera` and `scanmap.rig.Streaming`.

    Args:
        camera: exposes the moment it is asked, and stamps its pictures with that moment.
        clock: [s] the clock those stamps are of.
        wait: lets that clock go on [s].
        period_s: from one picture to the next.
        latency_s: how much later than its exposure a picture arrives and is stamped.
        jitter_s: standard deviation of that.
        corrected_s: what the rig believes the latency to be, taken off every stamp.
        rng: of the jitter.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        clock: Callable[[], float],
        wait: Callable[[float], None],
        period_s: float,
        latency_s: float,
        jitter_s: float,
        corrected_s: float,
        rng: np.random.Generator,
    ) -> None:
        self._camera = camera
        self._clock, self._wait = clock, wait
        self._period_s, self._latency_s, self._jitter_s = period_s, latency_s, jitter_s
        self._corrected_s = corrected_s
        self._rng = rng
        self._coming: deque[Frame] = deque()  # exposed, with the time of their arrival

    @property
    def width(self) -> int:
        """Image width [px]."""
        return self._camera.width

    @property
    def height(self) -> int:
        """Image height [px]."""
        return self._camera.height

    def grab(self) -> Frame:
        """A picture exposed now; returns when it has arrived."""
        frame = self._camera.grab()
        delay = self._delay()
        if delay:
            self._wait(delay)
        return Frame(frame.image, frame.time + delay - self._corrected_s)

    def newest(self) -> Frame:
        """The next picture to arrive; others are exposed meanwhile."""
        while not self._coming or self._coming[0].time > self._clock():
            now = self._clock()  # it runs freely, whoever looks and however long nobody did
            self._wait((math.floor(now / self._period_s + 1e-6) + 1) * self._period_s - now)
            frame = self._camera.grab()
            self._coming.append(Frame(frame.image, frame.time + self._delay()))
        image, arrival = self._coming.popleft()
        return Frame(image, arrival - self._corrected_s)

    def expose(self, exposure_us: float) -> None:
        """Expose so long from the next picture on [us]; pictures still on their way are dropped.

        Raises:
            CameraError: the camera cannot.
        """
        if not isinstance(self._camera, Exposing):
            raise CameraError("the exposure of this camera cannot be set")
        self._coming.clear()
        self._camera.expose(exposure_us)

    def close(self) -> None:
        """Free the camera; may be called twice."""
        self._camera.close()

    def _delay(self) -> float:
        if not self._jitter_s:
            return self._latency_s
        return max(0.0, float(self._rng.normal(self._latency_s, self._jitter_s)))
