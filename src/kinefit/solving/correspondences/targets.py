"""Checks and weights of measurements: the common part of all row makers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape, shaped
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.solving.correspondences import _kernels
from kinefit.solving.rows import Rows


def weights(sigma: ArrayLike, present: NDArray, what: str) -> NDArray:
    """Weights 1/σ² (K,) of measurements present (K,) bool, 0 for absent ones; sigma a scalar or (K,).

    Raises
    ------
    ObservationError
        A sigma of another shape, or not positive.
    """
    sigma = np.asarray(sigma, float)
    if sigma.shape not in ((), present.shape):
        raise ObservationError(f"deviations of {what} have shape {sigma.shape}", remedy=f"Give {present.shape}.")
    out = np.zeros(present.shape)
    if not present.any():
        return out
    stated = sigma[present] if sigma.shape else sigma
    if not (stated > 0).all():
        remedy = "Remove what was not measured, or give it a large one."
        raise ObservationError(f"the standard deviation of {what} must be positive", remedy=remedy)
    out[present] = 1.0 / stated**2
    return out


def fill(
    kernel: Any, lines: int, body: Body, state: BodyState, points: PointSet, *arguments: Any,
    frames: NDArray | None = None,
) -> Rows:  # fmt: skip
    """Run a row-making kernel for the points of a body at a state, with at most `lines` rows for each point.

    frames (S, 12): given for a body whose joints move with its angles.
    """
    frames = of_segments(body, state, frames)
    data, segment, group = _kernels.buffers(lines * len(points))
    end = kernel(frames, points.segments, body.points_rest(points), *arguments, data, segment, group, 0)
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])


def of_segments(body: Body, state: BodyState, frames: NDArray | None = None) -> NDArray:
    """Frames (S, 12) of a body's segments: those given, for joints that move with angles, else those of the tree."""
    return body.tree.forward(state.T_world_root, state.angles)[0] if frames is None else frames


def array(values: ArrayLike, columns: int, count: int, what: str) -> tuple[NDArray, NDArray]:
    """Values as contiguous floats (K, columns), and whether each row (K,) is finite; NaN means not measured."""
    out = shaped(values, (count, columns), what)
    return out, np.isfinite(out).all(axis=1)


def check_depth_image(depth: NDArray, camera: Camera) -> None:
    """Raise ObservationError for a depth image (H, W) of another size than its camera's."""
    remedy = "Give the camera of this image, or camera.scaled(size)."
    check_shape(depth, camera.size[::-1], f"a depth image of camera {camera.name}", remedy=remedy)


def lines(vectors: NDArray) -> NDArray:
    """Contiguous rows (3, K) of x, y and z from vectors (K, 3); zeros where not finite."""
    out = np.ascontiguousarray(vectors.T)
    finite = np.isfinite(out)
    return out if finite.all() else np.where(finite, out, 0.0)


def unit(directions: NDArray, present: NDArray, what: str) -> None:
    """Check that directions (K, 3) present (K,) are unit vectors, because their length scales a row's residual.

    Raises
    ------
    ObservationError
        One is not.
    """
    if np.any(np.abs(np.linalg.norm(directions[present], axis=1) - 1.0) > 1e-6):
        raise ObservationError(f"{what} are not unit vectors", remedy="Divide them by their lengths.")


def cameras(rig: Rig, camera: ArrayLike, count: int) -> NDArray:
    """Checked camera indices (K,) in the rig, from (K,) or one for all; kernels do not check them.

    Raises
    ------
    ObservationError
        Indices of another shape or type, or out of range.
    """
    index = np.asarray(camera)
    if index.shape not in ((), (count,)) or index.dtype.kind not in "iu":
        raise ObservationError(f"camera indices have shape {index.shape}", remedy=f"Give ({count},) integers, or one.")
    if index.size and not 0 <= index.min() <= index.max() < len(rig):
        problem = f"a camera index lies outside 0 to {len(rig) - 1}"
        raise ObservationError(problem, remedy=f"The cameras of the rig are: {', '.join(rig.names)}.")
    return np.array(np.broadcast_to(index, count), np.int64)
