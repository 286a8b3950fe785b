"""Lines that the room's own light may have moved, looked at again with that light taken away.

Joints of tiles, paint and shadows under the line move it, and where no laser-off frame was taken its picture alone does
not tell by how much. Other bearings' pictures do (`room_light`): a line that leans over many rows, or is not as wide as
usual, is found once more against what they show, as with a laser-off frame. It is replaced where it is moved by more
than noise explains, or is better known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import ROWS, Moved, Reason, Usual
from scanmap.pipeline.moving import move
from scanmap.pipeline.room_light import unlit
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline, Step
from scanmap.pipeline.widths import Widths
from scanmap.scan import Scan
from scanmap.shot import Shot

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Key = tuple[float, float]  # time and bearing of a shot

# How much a line leans, or how far the logarithm of its width is from the usual one's, in means of some blocks of rows,
# from which on it is asked, and how many such there are. In 33 drawn sweeps that is 45 % of the bearings, with 99 % of
# what all of them would gain.
_LEANS, _UNUSUAL, _BLOCKS, _MANY = 0.03, 0.07, 3, 6
_MOST = 100  # bearings that are asked, each of which costs as ten others do
# How far the line must have moved on in another bearing's picture, and how far the head may have turned to it.
_MOVED_ON_PX, _FARTHEST = 60.0, float(np.radians(12.0))
_FEWEST = 25  # rows in which the room's light is known
# Between both looks at one line; and what it has at least of its height: the other picture may show a line, too.
_SAME_PX, _LOWER = 3.0, 0.6
# By how much it is moved at least, in means along it and in their scatter; or what is left of its sigma.
_LEAST_PX, _SURE, _SURER = 0.03, 3.0, 0.7
# So many pictures' places say how far one lies beside its own that does not tell it; how far is too far; and over which
# way an edge under the line does what it does.
_PAIRS, _TOO_FAR_PX, _WAY_PX = 3, 0.3, 1.0


class Replaced(NamedTuple):
    """Lines (B, H) that were replaced."""

    all: Mask
    by_flank: Mask  # of them, by one of their flanks alone


class _Job(NamedTuple):
    k: int  # of the bearing
    shot: Shot
    others: list[tuple[int, Shot]]


class _Found(NamedTuple):
    k: int
    step: Step  # without its shot's pictures
    told: Mask  # (H,) rows in which the room's light is known
    sigma_px: F64  # (H,) how well its place is
    slid_px: list[float]
    moved: Moved


def look_without_light(
    scan: Scan,
    pipeline: Pipeline,
    usual: Widths,
    lean: Sequence[F32 | None],
    asked: Mask,
    shots: Callable[[], Iterable[Shot]],
    keys: Sequence[Key],
    take: Callable[[int, Mask, Mask, Step], None],
) -> Replaced:
    """Replace lines in `scan`, in place, by what they are without the room's light.

    Args:
        usual: how wide the scan's lines are.
        lean: of each bearing, how much the profile leans, as `Look` has it.
        asked: (B, H) cells in question; bearings without any say nothing of others.
        shots: the shots of the scan once more.
        keys: of each bearing's shot.
        take: is told of a bearing which rows (H,) are replaced, which were found without the room's light at all, and
            what was.
    """
    replaced = Replaced(*np.zeros((2, len(scan), scan.rows), bool))
    speaks, focal_px = np.asarray(asked.any(axis=1)), pipeline.calibration.intrinsics.fx
    others = {k: _others(scan.bearings, speaks, k, focal_px) for k in _doubtful(usual, lean, speaks)}
    others = {k: some for k, some in others.items() if some}
    if not others:
        return replaced
    seen = {k: usual.of_bearing(k) for k in others}

    def look(job: _Job) -> _Found | None:
        picture = pipeline.picture(job.shot)
        beside = [(j, pipeline.picture(shot)) for j, shot in job.others]
        if picture is None:
            return None
        there = [(j, other) for j, other in beside if other is not None]
        dark = unlit(scan, pipeline.calibration, job.k, picture, there, pipeline.channel_of(picture))
        if np.count_nonzero(dark.told & asked[job.k]) < _FEWEST:
            return None
        step = pipeline.look_without(job.shot, picture, dark.picture)
        line, own = np.where(dark.told, step.line.column_px, np.nan), seen[job.k]
        known = Usual(own.width_px, own.slant_known)
        moved = pipeline.clean_flanks_without(job.shot, picture, dark.picture, line, known)
        # All are held until it is known how far pictures lie beside their places.
        step = step._replace(shot=replace(step.shot, image=b"", background=None))
        return _Found(job.k, step, dark.told, dark.sigma_px, dark.slid_px, moved)

    looks: list[_Found | None] = []
    run(_jobs(others, shots(), keys), look, [looks.append])
    found = [one for one in looks if one is not None]
    beside_px = _usually([slid for one in found for slid in one.slid_px])
    for one in found:
        k, moved = one.k, one.moved
        rows, alone, doubt = _told(scan, asked[k], one, beside_px)
        replaced.all[k], replaced.by_flank[k] = rows, rows & (moved.by != 0.0)
        scan.amend(k, rows, one.step.profile)
        take(k, rows, alone, one.step)
        move(scan, pipeline, k, np.flatnonzero(rows), moved.by[rows], np.hypot(moved.doubt, doubt)[rows])
    return replaced


def _told(scan: Scan, asked: Mask, found: _Found, beside_px: float) -> tuple[Mask, Mask, F64]:
    """Of a bearing's rows (H,) those that are replaced and those found without the room's light; and a doubt [px]."""
    k, profile = found.k, found.step.profile
    by = profile.column_px - scan.column_px[k].astype(np.float64)
    slid = np.where(np.isfinite(found.sigma_px), found.sigma_px, beside_px)
    with np.errstate(invalid="ignore"):
        alone = scan.valid[k] & (profile.reason == Reason.OK) & (np.abs(by) < _SAME_PX)
        alone &= asked & found.told & (slid < _TOO_FAR_PX) & (profile.intensity > _LOWER * scan.intensity[k])
        surer = profile.sigma_m < _SURER * scan.sigma_m[k]
    doubt = np.where(alone, slid, 0.0) * np.where(alone, np.abs(by), 0.0) / _WAY_PX
    return alone & (_moved(by, alone) | surer), alone, doubt


def _doubtful(usual: Widths, lean: Sequence[F32 | None], speaks: Mask) -> list[int]:
    """Bearings whose line leans over many rows, or is not as wide as usual; of too many those that most do."""
    ratio, slant_known = usual.ratios()
    unknown = np.full(ratio.shape[1], np.nan, np.float32)
    leans = _along(np.stack([unknown if own is None else own for own in lean])) / _LEANS
    unusual = _along(np.where(slant_known, ratio, np.nan)) / _UNUSUAL
    much = {
        k: float(np.maximum(leans[k], unusual[k]).sum())
        for k in np.flatnonzero(speaks).tolist()
        if max(np.count_nonzero(own[k] > 1.0) for own in (leans, unusual)) >= _MANY
    }
    return sorted(sorted(much, key=lambda k: -much[k])[:_MOST])


def _along(values: F32 | F64) -> F32:
    """Sizes (B, n) of means of what is known of values (B, n) along lines; zero where nothing is."""
    known = np.isfinite(values)
    total, count = (
        np.asarray(cv2.blur(own.astype(np.float32), (_BLOCKS, 1), borderType=cv2.BORDER_CONSTANT), np.float32)
        for own in (np.where(known, values, 0.0), known)
    )
    return np.asarray(np.abs(total) / np.maximum(count, np.float32(1.0 / _BLOCKS)), np.float32)


def _others(bearings: F64, speaks: Mask, k: int, focal_px: float) -> list[int]:
    """The next bearings before and after the k-th in whose pictures the line has moved on."""
    found = []
    for way in (range(k - 1, -1, -1), range(k + 1, len(bearings))):
        for j in way:
            turned = abs(float(bearings[j] - bearings[k]))
            if turned > _FARTHEST:
                break
            if speaks[j] and turned * focal_px > _MOVED_ON_PX:
                found.append(j)
                break
    return found


def _jobs(others: dict[int, list[int]], shots: Iterable[Shot], keys: Sequence[Key]) -> Iterator[_Job]:
    """Each bearing with its others as soon as all of their shots are there; none is held for longer than it is used."""
    users: dict[int, set[int]] = {}
    for k, some in others.items():
        for j in (k, *some):
            users.setdefault(j, set()).add(k)
    places: dict[Key, list[int]] = {}
    for j in users:
        places.setdefault(keys[j], []).append(j)
    held: dict[int, Shot] = {}
    for shot in shots:
        for j in places.pop((shot.time, shot.bearing), []):
            held[j] = shot
            for k in sorted(users[j]):
                if all(i in held for i in (k, *others[k])):
                    yield _Job(k, held[k], [(i, held[i]) for i in others[k]])
                    for i in (k, *others[k]):
                        users[i].discard(k)
        held = {j: one for j, one in held.items() if users[j]}


def _moved(by: F64, rows: Mask) -> Mask:
    """Which lines (H,), in some rows, are moved by more than their scatter along each other explains."""
    some = np.where(rows, by, 0.0)
    count, total, squares = (
        cv2.blur(values[None], (ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0] * ROWS
        for values in (rows.astype(np.float64), some, np.square(some))
    )
    count = np.maximum(count, 1.0)
    mean = total / count
    scatter = np.sqrt(np.maximum(squares / count - np.square(mean), 0.0) / count)
    return np.asarray(np.abs(mean) > np.maximum(_LEAST_PX, _SURE * scatter))


def _usually(slid_px: list[float]) -> float:
    """How far pictures lie beside their places that do not tell it [px], by those that do."""
    return np.inf if len(slid_px) < _PAIRS else float(np.sqrt(np.mean(np.square(slid_px))))
