"""Surface samples against a depth image: each visible sample should lie on the surface measured at its pixel.

These rows go from the model to the data, `surface_rows` from the data to the model. Together they explain every
measured point and every visible part of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences import _kernels
from kinefit.solving.correspondences.occupancy import _kernels_depth_image
from kinefit.solving.correspondences.targets import check_depth_image
from kinefit.solving.rows import Rows

_VISIBILITY_MARGIN = 0.015  # [m] by which a visible sample may lie behind the body's rendered depth


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
    """One row for each visible sample p, measured at x: r = n·(x − p), point to plane along the model's normal n.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    samples : SurfaceSamples
    camera : Camera of the depth sensor, depth (H, W) [m] its image, 0 where nothing was measured.
    shown : (h, w) [m]
        The body's rendered depth in that camera at any size, inf for none. Samples occluded by the body make no row.
    reach : float [m]
        Correspondence distance: a measurement may lie this far in front of a sample or behind it.
    facing : float
        Smallest cosine between a sample's normal and the line of sight.
    sigma : float [m]

    Raises
    ------
    ObservationError
        An image of another size than the camera's, a standard deviation that is not positive.
    """
    check_depth_image(depth, camera)
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of a depth image is {sigma} m", remedy="Give positive metres.")
    data, segment, group = _kernels.buffers(len(samples))
    end = _kernels_depth_image.depth_image_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, depth, camera.ray_table, shown,
        shown.shape[1] / camera.size[0], _VISIBILITY_MARGIN, reach, facing, 1.0 / sigma**2, data, segment, group, 0,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])
