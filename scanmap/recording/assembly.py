"""Images, laser-off images and bearings, each with its own stamp, joined to shots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from scanmap.recording.layout import RecordingParams
from scanmap.recording.messages import SECOND_NS, StampedImage, StampedJoints
from scanmap.recording.source import Report
from scanmap.shot import Shot


class _Image(NamedTuple):
    """A laser-on image that waits for its bearing."""

    stamp_ns: int
    sequence: int
    image: bytes
    background: bytes | None


class _Bearing(NamedTuple):
    stamp_ns: int
    reported: float
    commanded: float


class Assembler:
    """Joins images, laser-off images and bearings to shots.

    In our own files all that belongs to a shot comes before its image, with the same stamp. In a bag of
    others the stamps differ and the order is loose: an image waits until bearings on both sides of its
    stamp have come, but never longer than `max_gap_s`.
    """

    def __init__(self, params: RecordingParams, report: Report, start_ns: int, own: bool, off: bool) -> None:
        self._params = params
        self._report = report
        self._start_ns = start_ns
        self._own = own
        self._gap_ns = round(params.max_gap_s * SECOND_NS)
        self._latest = -(1 << 62)
        self._bearings: deque[_Bearing] = deque()
        self._off: dict[int, bytes] = {}
        self._latest_off: float = -math.inf if off and not own else math.inf
        self._waiting: deque[_Image] = deque()
        self.done = 0
        self.joints_seen: set[str] = set()
        self.unmatched_off = 0
        self.without_bearing = 0

    def add_joints(self, joints: StampedJoints) -> None:
        """A JointState has come."""
        self._latest = max(self._latest, joints.stamp_ns)
        self.joints_seen.update(joints.positions)
        reported = joints.positions.get(self._params.joint, math.nan)
        commanded = joints.positions.get(self._params.commanded_joint, reported)
        if math.isfinite(reported):
            self._bearings.append(_Bearing(joints.stamp_ns, reported, commanded))

    def add_off(self, off: StampedImage) -> None:
        """A laser-off image has come."""
        self._latest = max(self._latest, off.stamp_ns)
        self._latest_off = max(self._latest_off, off.stamp_ns)
        self._off[off.stamp_ns] = off.image

    def add_image(self, on: StampedImage, sequence: int) -> None:
        """A laser-on image has come."""
        self._latest = max(self._latest, on.stamp_ns)
        self._waiting.append(_Image(on.stamp_ns, sequence, on.image, self._off.pop(on.stamp_ns, None)))

    def ready(self, at_end: bool = False) -> Iterator[Shot]:
        """Shots that are complete, in the order of their images."""
        while self._waiting:
            image = self._waiting[0]
            late = at_end or self._latest > image.stamp_ns + self._gap_ns
            bearing = self._bearing(image.stamp_ns)
            if image.background is None:
                image = self._waiting[0] = image._replace(background=self._off.pop(image.stamp_ns, None))
            off_may_come = image.background is None and self._latest_off < image.stamp_ns
            if not late and (bearing is None or off_may_come):
                break
            self._waiting.popleft()
            if bearing is None:
                self._miss(image.stamp_ns)
            else:
                index = image.sequence if self._own else self.done
                self.done += 1
                time = (image.stamp_ns - self._start_ns) / SECOND_NS
                if self._own:
                    self._bearings.clear()
                    self.unmatched_off += len(self._off)
                    self._off.clear()
                yield Shot(index, bearing.reported, bearing.commanded, time, image.image, image.background)
        self._forget()

    def _bearing(self, stamp_ns: int) -> _Bearing | None:
        """The bearing at a stamp: as it was sent, else between its neighbours the short way round."""
        before: _Bearing | None = None
        after: _Bearing | None = None
        for bearing in reversed(self._bearings):
            if bearing.stamp_ns == stamp_ns:
                return bearing
            if bearing.stamp_ns < stamp_ns:
                before = bearing if before is None or bearing.stamp_ns > before.stamp_ns else before
            elif after is None or bearing.stamp_ns < after.stamp_ns:
                after = bearing
        if before is None or after is None or after.stamp_ns - before.stamp_ns > self._gap_ns:
            return None
        part = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        turn = math.remainder(after.reported - before.reported, math.tau)
        turn_commanded = math.remainder(after.commanded - before.commanded, math.tau)
        return _Bearing(stamp_ns, before.reported + part * turn, before.commanded + part * turn_commanded)

    def _miss(self, stamp_ns: int) -> None:
        self.without_bearing += 1
        if self.without_bearing > 3:  # a bag without bearings would say so for each of its images
            return
        self._report(
            f"image at {stamp_ns / SECOND_NS:.3f} s left out: no bearing of joint {self._params.joint!r} on both sides "
            f"of it within recording.max_gap_s = {self._params.max_gap_s:g} s"
        )

    def _forget(self) -> None:
        """Keep what a waiting image, or one that comes a little late, can need."""
        if self._own:  # kept by `ready`: stamps need not even ascend
            return
        oldest = self._waiting[0].stamp_ns if self._waiting else self._latest
        limit = min(oldest, self._latest) - self._gap_ns
        while len(self._bearings) > 1 and self._bearings[0].stamp_ns < limit:
            self._bearings.popleft()
        for stamp in [stamp for stamp in self._off if stamp < limit]:
            del self._off[stamp]
            self.unmatched_off += 1

    def finish(self) -> Iterator[Shot]:
        """What is left at the end of the recording."""
        yield from self.ready(at_end=True)
        self.unmatched_off += len(self._off)
        if self.without_bearing > 3:
            self._report(f"{self.without_bearing} images in all were left out for want of a bearing")
        if self.unmatched_off:
            self._report(f"{self.unmatched_off} laser-off images have no laser-on image with the same stamp")
