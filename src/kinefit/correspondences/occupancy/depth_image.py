"""Surface samples against a depth image: each visible one should lie in the surface that was measured at its pixel.

From the model to the data, as `surface_rows` goes from the data to the model: together they leave neither a measured
point without a surface nor a visible surface without a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences import _kernels
from kinefit.correspondences.occupancy import _kernels_depth_image
from kinefit.correspondences.targets import check_depth_image
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.rows import Rows

_SKIN = 0.015  # [m] by which a sample may lie behind the body's own depth and still count as visible


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
    frames: NDArray,
    samples: SurfaceSamples,
    camera: Camera,
    depth: NDArray,
    shown: NDArray,
    *,
    reach: float = 0.05,
    facing: float = 0.2,
    sigma: float = 0.01,
) -> Rows:
    """One row for each sample p that the sensor saw, at x: r = n·(x − p), point to plane along the model's normal n.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    samples : SurfaceSamples
    camera : Camera of the depth sensor, depth (H, W) [m] its image, 0 where nothing was measured.
    shown : (h, w) [m]
        The body's own depth in that camera at any size, inf where it is not: what it hides itself makes no row.
    reach : float [m]
        How far in front of a sample, or behind it, a measurement may lie to be the sample's.
    facing : float
        Least cosine between a sample's normal and the line of sight.
    sigma : float [m]

    Raises
    ------
    ObservationError
        An image of another size than the camera's, a standard deviation that is not positive.
    """
    check_depth_image(depth, camera)
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of a depth image is {sigma} m", remedy="Give a positive one.")
    data, segment, group = _kernels.buffers(len(samples))
    end = _kernels_depth_image.depth_image_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, depth, camera.ray_table, shown,
        shown.shape[1] / camera.size[0], _SKIN, reach, facing, 1.0 / sigma**2, data, segment, group, 0,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])
