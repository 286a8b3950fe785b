"""Boards while they are collected from a running camera: the picture, what is covered, what to show next."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError
from scanmap.shot import Image
from scanmap.view import entities as at
from scanmap.view.pictures import jpeg, shrink_factor, shrunk
from scanmap.view.viewer import LOOPBACK, check_port

if TYPE_CHECKING:
    import rerun.blueprint as rrb

Array = NDArray[np.float64]

WIDTH_MOST = 960  # [px] of the picture that is sent
PERIOD_S = 0.1  # between pictures without news
CELL_PX = 40
_GOOD, _LOST, _LINE = [0, 158, 115], [213, 94, 0], [0, 220, 255]


class BoardView:
    """A live view of boards; closed at the end."""

    def __init__(self, port: int, *, coverage: bool) -> None:
        """Serve it on a port of this machine, with the map of what is covered or without.

        Raises:
            ConfigError: the port is taken.
        """
        import rerun as rr

        check_port(port)
        self._recording = rr.RecordingStream(f"{at.APPLICATION}-boards-live")
        try:
            # A server that viewers connect to: a frozen viewer stalls nothing.
            server = rr.GrpcServerSink(LOOPBACK, port, server_memory_limit="256MB")
            self._recording.set_sinks(server, default_blueprint=_layout(coverage=coverage))
        except (RuntimeError, OSError) as error:
            raise ConfigError(f"the live view cannot be served on port {port}: {error}; try --no-view") from error
        self._number, self._shown = 0, -np.inf

    def show(
        self, image: Image, corners: Array | None, line: Array | None, counts: NDArray[np.intp], words: Sequence[str]
    ) -> None:
        """Show a picture.

        Args:
            image: (H, W, 3) BGR.
            corners: (N, 2) of the board where the picture counts, else None [px].
            line: (M, 2) of the laser line on it, or None [px].
            counts: (rows, columns) corners per cell of the picture so far.
            words: what was found and what to show next, a line each.
        """
        now = time.monotonic()
        if corners is None and now - self._shown < PERIOD_S:
            return
        import rerun as rr

        self._shown, self._number = now, self._number + 1
        self._recording.set_time("picture", sequence=self._number)
        factor = shrink_factor(image.shape[1], WIDTH_MOST)
        sent = jpeg(shrunk(image, factor), 75)
        self._recording.log("picture", rr.EncodedImage(contents=sent.data, media_type=sent.media_type))
        self._points("picture/corners", corners, factor, _GOOD, 4.5)
        self._points("picture/line", line, factor, _LINE, 2.0)
        self._recording.log("coverage", rr.Image(_cells(counts)))
        self._recording.log("next", rr.TextDocument("\n\n".join(words), media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Flush and end the server."""
        self._recording.flush()
        self._recording.disconnect()

    def _points(self, path: str, points: Array | None, factor: int, colour: list[int], radius: float) -> None:
        import rerun as rr

        if points is None:
            self._recording.log(path, rr.Clear(recursive=False))
            return
        # A pixel of the smaller picture is the mean of a block, its centre at +0.5 in the viewer.
        at_px = (points + 0.5) / factor
        self._recording.log(path, rr.Points2D(at_px, colors=colour, radii=rr.Radius.ui_points(radius)))


def _cells(counts: NDArray[np.intp]) -> Image:
    """(rows, columns) as a picture: vermilion where nothing was seen, ever greener with corners."""
    share = np.clip(counts / 8.0, 0.0, 1.0)[..., None]
    colours = np.where(counts[..., None] == 0, np.array(_LOST), (0.35 + 0.65 * share) * np.array(_GOOD))
    cells = np.repeat(np.repeat(np.rint(colours).astype(np.uint8), CELL_PX, axis=0), CELL_PX, axis=1)
    cells[::CELL_PX] = cells[:, ::CELL_PX] = 30
    return cells


def _layout(*, coverage: bool) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    words = rrb.TextDocumentView(origin="/next", name="What to show next")
    covered = rrb.Spatial2DView(origin="/coverage", name="Covered: green; still empty: orange")
    beside = rrb.Vertical(words, covered, row_shares=[1, 1]) if coverage else words
    camera = rrb.Spatial2DView(origin="/picture", name="Camera")
    return rrb.Blueprint(rrb.Horizontal(camera, beside, column_shares=[2, 1]), collapse_panels=True)
