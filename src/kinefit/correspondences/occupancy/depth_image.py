"""Surface samples against a depth image: each visible one should lie in the surface that was measured at its pixel.

From the model to the data, as `surface_rows` goes from the data to the model: together they leave neither a measured
point without a surface nor a visible surface without a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences import _kernels, targets
from kinefit.correspondences.occupancy import _kernels_depth_image
from kinefit.correspondences.occupancy._kernels_depth_image import EMPTY, HIDDEN, MATCHED, UNSEEN
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.rows import Rows

__all__ = ["EMPTY", "HIDDEN", "MATCHED", "UNSEEN", "SurfaceSamples", "depth_image_rows"]


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of the body's surface.

    Parameters
    ----------
    segment : (N,) int
    point : (3, N) [m] in the root frame at rest
    normal : (3, N) unit, outward
    """

    segment: NDArray
    point: NDArray
    normal: NDArray

    def __post_init__(self) -> None:
        order = np.argsort(self.segment, kind="stable")
        for name, dtype in (("segment", np.int64), ("point", float), ("normal", float)):
            array = np.ascontiguousarray(np.asarray(getattr(self, name), dtype)[..., order])
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.segment)


def depth_image_rows(
    body: Body,
    state: BodyState,
    samples: SurfaceSamples,
    camera: Camera,
    depth: NDArray,
    shown: NDArray,
    *,
    before: float = 0.05,
    behind: float = 0.05,
    skin: float = 0.015,
    facing: float = 0.2,
    sigma: float = 0.01,
    verdict: NDArray | None = None,
    frames: NDArray | None = None,
) -> Rows:
    """One row for each sample p that the sensor saw, at x: r = n·(x − p), point to plane along the model's normal n.

    Parameters
    ----------
    samples : SurfaceSamples
    camera : Camera of the depth sensor, depth (H, W) [m] its image, 0 where nothing was measured.
    shown : (h, w) [m]
        The body's own depth in that camera at any size, inf where it is not: what it hides itself makes no row.
    before, behind : float [m]
        How far in front of a sample, and behind it, a measurement may lie to be the sample's.
    skin : float [m]
        How far a sample may lie behind `shown` and still count as visible.
    facing : float
        Least cosine between a sample's normal and the line of sight.
    sigma : float [m]
    verdict : (N,) int64, optional
        To be filled with what the image tells of every sample: UNSEEN, HIDDEN (something was measured in front), EMPTY
        (seen through) or MATCHED.
    frames : (S, 12), optional, of a body whose joints move with its angles.

    Raises
    ------
    ObservationError
        An image of another size than the camera's, a standard deviation that is not positive.
    """
    if depth.shape != (camera.size[1], camera.size[0]):
        problem = f"a depth image of {depth.shape[1]}x{depth.shape[0]} px, camera {camera.name} has {camera.size}"
        raise ObservationError(problem, remedy="Give the camera of this image, or camera.scaled(size).")
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of a depth image is {sigma} m", remedy="Give a positive one.")
    frames = targets.of_segments(body, state, frames)
    n = len(samples)
    data, segment, group = _kernels.buffers(n)
    verdict = np.empty(n, np.int64) if verdict is None else verdict
    end = _kernels_depth_image.depth_image_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, depth, camera.ray_table, shown,
        shown.shape[1] / camera.size[0], skin, before, behind, facing, 1.0 / sigma**2,
        data, segment, group, 0, verdict,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])
