"""Ray casting against triangle meshes: the only importer of open3d.

open3d links against libusb-1.0.so.0, which a fresh machine lacks; the wheel `libusb-package` carries it
under that very soname. Loaded into the process first, the dynamic linker finds it there.
"""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanmap.errors import ConfigError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@cache
def load_open3d() -> Any:
    """The `open3d` module, with libusb found first.

    Raises:
        ConfigError: open3d cannot be imported; the message carries the linker's own words.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # a system with its own libusb, or none needed; open3d's import decides
    try:
        with _signals_wait():
            import open3d
    except (ImportError, OSError) as error:
        raise ConfigError(f"open3d cannot be loaded ({error}); try `pip install open3d libusb-package`") from error
    return open3d


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Hold back what would stop this process, for the fraction of a second that a native library takes to load.

    open3d that is half loaded counts its memory as leaked, and ends the process with a page of it and exit code 1.
    """
    came: list[int] = []
    before = {}
    if threading.current_thread() is threading.main_thread():  # no other may, and none is interrupted
        # Blocked in this thread they would come to another, and interrupt this one all the same.
        before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in _STOPPING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


class Hits(NamedTuple):
    """What N rays met first."""

    distance: NDArray[np.floating]  # (N,) in lengths of the direction, inf where nothing was met
    triangle: NDArray[np.int32]  # (N,) index, -1 where nothing was met
    uv: F32  # (N, 2) barycentric: p = (1 - u - v) a + u b + v c


class RayScene:
    """A triangle mesh that rays are cast into, by Embree through open3d.

    Embree works in float32: an origin some metres from the frame's origin is rounded to 0.2 um, and so is
    the distance of a hit. Where more counts, `cast(exact=True)` meets the plane of the triangle that was
    hit again in float64.
    """

    def __init__(self, vertices: ArrayLike, triangles: ArrayLike) -> None:
        """Build from vertices (N, 3) [m] and triangles (M, 3), indices into them."""
        self.vertices: F64 = np.array(vertices, np.float64).reshape(-1, 3)
        self.triangles: NDArray[np.int64] = np.array(triangles, np.int64).reshape(-1, 3)
        if not len(self.triangles):
            raise ConfigError("mesh has no triangles; give a file that holds a surface, not a point cloud")
        # What is cast into is what Embree sees: vertices rounded to float32.
        self.vertices = self.vertices.astype(np.float32).astype(np.float64)
        corners = self.vertices[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self.areas: F64 = 0.5 * length[:, 0]  # (M,) [m^2]
        self.normals: F64 = normals / np.maximum(length, 1e-300)  # (M, 3) unit, right-hand rule
        self._tensor = load_open3d().core.Tensor
        self._scene = load_open3d().t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(self.vertices.astype(np.float32)), self._tensor(self.triangles.astype(np.uint32))
        )

    def cast(self, origins: ArrayLike, directions: ArrayLike, *, exact: bool = False) -> Hits:
        """First hits of rays.

        Args:
            origins: (3,) or (N, 3) [m].
            directions: (N, 3), any length.
            exact: distances in float64, for measuring; float32 is enough for looking.
        """
        rays = _rays(origins, directions)
        # One thread: a second one halves the wait and doubles the CPU time, which the decoders need.
        found = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        distance = found["t_hit"].numpy()
        # Embree's number for nothing is the largest uint32: -1 once it is signed.
        triangle = found["primitive_ids"].numpy().view(np.int32)
        if exact:
            distance = distance.astype(np.float64)
            met = np.flatnonzero(triangle >= 0)
            normal = self.normals[triangle[met]]
            start = np.broadcast_to(np.asarray(origins, np.float64), rays[:, :3].shape)[met]
            corner = self.vertices[self.triangles[triangle[met], 0]]
            along = np.einsum("ij,ij->i", normal, np.asarray(directions, np.float64)[met])
            usable = np.abs(along) > 1e-9
            t = np.einsum("ij,ij->i", normal, corner - start)[usable] / along[usable]
            distance[met[usable]] = t
        return Hits(distance, triangle, found["primitive_uvs"].numpy())

    def occluded(self, origins: ArrayLike, targets: ArrayLike, *, margin_m: float = 5e-4) -> NDArray[np.bool_]:
        """Whether anything stands between origins (3,) or (N, 3) and targets (N, 3) [m].

        What lies within `margin_m` of the target is taken for the surface the target lies on.
        """
        goal = np.asarray(targets, np.float64)
        rays = _rays(origins, goal - np.asarray(origins, np.float64))
        length = np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
        rays[:, 3:] *= np.maximum(1.0 - margin_m / np.maximum(length, 1e-9), 0.0)
        blocked: NDArray[np.bool_] = self._scene.test_occlusions(
            self._tensor(rays), tnear=0.0, tfar=1.0, nthreads=1
        ).numpy()
        return blocked

    def distance(self, points: ArrayLike) -> F32:
        """Unsigned distance (N,) [m] of points (N, 3) to the surface."""
        query = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        return np.asarray(self._scene.compute_distance(self._tensor(query)).numpy(), np.float32)


def _rays(origins: ArrayLike, directions: ArrayLike) -> F32:
    """(N, 6) float32 rays."""
    heading = np.asarray(directions)
    rays = np.empty((len(heading), 6), np.float32)
    rays[:, :3] = origins
    rays[:, 3:] = heading
    return rays
