"""A sweep as a session runs it: its plan, its eyes, and what an interrupted one left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.session.refining import Refinement
from scanmap.session.resuming import Earlier, prove_place
from scanmap.session.rigs import OpenRig
from scanmap.session.watching import watch_of
from scanmap.shot import Shot
from scanmap.sweep import Plan, Withdraw, grab, sweep


class Sweeping:
    """The sweep of an open rig, whole or the rest of one."""

    def __init__(
        self, config: Config, calibration: Calibration, opened: OpenRig, planned: Plan, earlier: Earlier | None
    ) -> None:
        self._config = config
        self._opened = opened
        self._planned = planned
        self._earlier = earlier
        self.note: Callable[[str], None] = lambda _: None  # told of every fault that was overcome, one line each
        self.withdraw: Withdraw = lambda indices, why: None  # told of shots that cannot be trusted
        self._watch = watch_of(config, calibration)
        self.refinement = Refinement(config, calibration) if config.sweep.mode == "adaptive" else None

    def prove_place(self) -> str:
        """Before a scan is gone on with: see `resuming.prove_place`."""
        assert self._earlier is not None
        return prove_place(self._opened, self._earlier, self._watch)

    def look_first(self) -> None:
        """Before a scan begins: what the head sees where it stands, so that it cannot be moved unnoticed any more.

        Raises:
            CameraError, StageError: the camera sends nothing usable, or the board does not answer.
        """
        if self._config.sweep.watch:
            camera, stage = self._opened.rig.camera, self._opened.rig.stage
            frame = grab(camera, self._config.sweep.retries, self.note)
            here = stage.where()
            self._watch.stand_from(Shot(-1, here, here, frame.time, frame.image, frame.image))

    def shots(self) -> Iterator[Shot]:
        """The shots that are still to be taken, on the clock of the scan."""
        refinement, earlier, opened = self.refinement, self._earlier, self._opened
        twin = opened.twin
        if earlier is not None and twin is not None:
            twin.camera.remember(earlier.bearings)
        offset_s = earlier.offset_s if earlier is not None else 0.0
        for shot in sweep(
            opened.rig,
            self._config.sweep,
            sleep=opened.sleep,
            clock=opened.clock,
            refine=None if refinement is None else refinement.bearings,
            watch=self._watch if self._config.sweep.watch else None,
            done=earlier.done if earlier is not None else (),
            note=self.note,
            withdraw=self.withdraw,
        ):
            if twin is not None:
                twin.camera.shot_taken(shot.bearing)
            yield replace(shot, time=shot.time + offset_s)
