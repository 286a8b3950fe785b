"""The axis and the camera solved together: views of one turn also say a little about the focal length."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, uncertainty_of
from scanmap.calibration.uncertainty import INTRINSICS

Array = NDArray[np.float64]

# Squared distance of nine parameters, in their sigmas, that chance exceeds once in ten thousand (chi squared).
FAR_SQUARED = 33.7


class Joint(NamedTuple):
    """One step of the joint adjustment."""

    step: Array  # (10,) of the axis's unknowns
    camera: Array  # (9,) change of INTRINSICS that the views ask for; not written anywhere
    own: Array  # (4, 4) covariance of the mount by the corners' noise
    slope: Array  # (4, 9) of the mount by the intrinsics in the file
    agrees: bool  # whether the change is one that the camera's own uncertainty allows


def joint_step(residuals: Array, J: Array, J_camera: Array, calibration: Calibration) -> Joint | None:
    """Gauss-Newton step of axis and intrinsics, the intrinsics held by their covariance; None without one.

    With the intrinsics fixed their error goes into the offset whole: a focal length off by 0.01 % moves the axis by
    0.01 % of the board's distance. The bearings know how far the head turned, and with that a part of the focal length.

    Args:
        residuals: (R,) of all corners at the solution with the intrinsics of `calibration` [px].
        J: (R, 10) derivative of the residuals by the axis's unknowns; the mount first.
        J_camera: (R, 9) by INTRINSICS.

    Source: Bayesian least squares, [J Jc]'[J Jc] / s2 + C^-1 for the normal matrix (Triggs et al., "Bundle
    adjustment - a modern synthesis", 2000).
    """
    known = uncertainty_of(calibration)
    if known is None or not set(INTRINSICS) <= set(known.names):
        return None
    at = [known.names.index(name) for name in INTRINSICS]
    sigma = np.sqrt(np.diag(known.matrix)[at])
    if not (sigma > 0).all():
        return None
    variance = float(residuals @ residuals) / max(1, len(residuals) - J.shape[1])
    # In units of the camera's sigmas, and of each column's length: the numbers differ by ten orders of magnitude.
    prior = np.linalg.pinv(known.matrix[np.ix_(at, at)] / np.outer(sigma, sigma))
    n = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    both = np.concatenate([J / length, J_camera * sigma], axis=1) / np.sqrt(variance)
    normal = both.T @ both
    normal[n:, n:] += prior
    inverse = np.linalg.pinv(normal)
    scale = np.concatenate([1.0 / length, sigma])
    step = -scale * (inverse @ (both.T @ (residuals / np.sqrt(variance))))
    # How the mount moves with the camera of the file, which the prior holds it to.
    slope = (scale[:, None] * inverse[:, n:] @ prior)[:4] / sigma
    of_noise = scale[:, None] * inverse @ both.T
    change = step[n:] / sigma
    return Joint(
        step[:n], step[n:], (of_noise @ of_noise.T)[:4, :4], slope, bool(change @ prior @ change < FAR_SQUARED)
    )
