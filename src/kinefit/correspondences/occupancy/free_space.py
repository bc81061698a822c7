"""Free space: where a depth sensor saw through to something behind, the body is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences import _kernels
from kinefit.correspondences.occupancy import _kernels_space as kernels
from kinefit.correspondences.occupancy.depth_image import SurfaceSamples
from kinefit.correspondences.targets import check_depth_image
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.rows import Rows

COLUMNS = 160  # of the map of cells: a person at 2 to 4 m is then some 20 to 40 cells wide, at any resolution


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A depth image with, for every cell of pixels, the nearest one that the body could stand in.

    Parameters
    ----------
    depth : (H, W) [m]
        Along the optical axis; 0 where nothing was measured, negative where it is known to be something else's.
    nearest : (h, w) int32, row * w + column of that cell; -1 where the body cannot be in the picture at all
    missing : (h, w) int32, the same among the cells that the body as it stands does not explain; -1 for none
    cell : int [px] width and height of a cell
    """

    depth: NDArray
    nearest: NDArray
    missing: NDArray
    cell: int

    @classmethod
    def of(
        cls,
        depth: NDArray,
        *,
        farthest: float,
        shown: NDArray | None = None,
        tolerance: float = 0.1,
        columns: int = COLUMNS,
    ) -> FreeSpace:
        """Free space of one depth image.

        Parameters
        ----------
        depth : (H, W) [m]
            0 where nothing was measured, negative where it is known to be something else's.
        farthest : float [m]
            What lies farther along the optical axis cannot be the body: the back of its predicted box. What lies
            nearer may hide it, so it counts as a place for it.
        shown : (h', w') [m], optional
            The body's own depth in that camera at any size, inf where it is not. What it explains within `tolerance`
            [m] is no place for the rest of it: a limb astray then goes to where one is missing, not to the head or
            the trunk because they are nearer. Leave it out only where the body is all but right.
        columns : int
            Cells across the image, at least; more cost more and follow an outline more finely.

        Raises
        ------
        ObservationError
            An image that is none, or a `farthest` that is not positive.
        """
        if np.ndim(depth) != 2 or not np.size(depth):
            problem = f"a depth image has shape {np.shape(depth)}"
            raise ObservationError(problem, remedy="Give (height, width) in metres.")
        if not farthest > 0.0:
            remedy = "Give it in metres along the optical axis."
            raise ObservationError(f"the farthest place of the body is {farthest} m", remedy=remedy)
        cell = max(depth.shape[1] // max(columns, 1), 1)
        nearest, missing = np.full((2, -(-depth.shape[0] // cell), -(-depth.shape[1] // cell)), -1, np.int32)
        kernels.nearest_cells(depth, farthest, cell, np.empty((0, 0), np.float32), tolerance, nearest)
        if shown is not None:
            own = np.ascontiguousarray(shown, np.float32)
            kernels.nearest_cells(depth, farthest, cell, own, tolerance, missing)
        return cls(depth, nearest, missing, cell)

    def middle(self, cells: NDArray) -> NDArray:
        """(N, 2) [px] middles of cells (N,), row * w + column."""
        row, column = np.divmod(np.asarray(cells), self.nearest.shape[1])
        return np.stack([column, row], axis=1) * float(self.cell) + (0.5 * self.cell - 0.5)


def free_space_rows(
    frames: NDArray,
    samples: SurfaceSamples,
    space: FreeSpace,
    camera: Camera,
    *,
    sigma: float | None = None,
    tolerance: float = 0.1,
    reach: float = 0.5,
    chosen: NDArray | None = None,
) -> Rows:
    """One row for each sample in space that the sensor saw through: sideways to the edge of the nearest cell that fits.

    With g = −∂(distance in the image)/∂x: n = g/|g|, r = distance/|g|, w = |g|²/σ², the exact linearisation, as in
    `pixel_rows`. A sample that is turned away from the camera, lies beside its image, where nothing was measured, or
    behind what was measured makes no row.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    samples : SurfaceSamples
    space : FreeSpace of the camera's image
    camera : Camera
    sigma : float [px]
        By default ten cells: samples beside each other tell the same, and the nearest place is often not the right
        one; measured points should decide where they can.
    tolerance : float [m]
        How far behind a sample a measurement must lie to speak against it: more than three deviations of the sensor
        and what a surface of simple shapes is off.
    reach : float [m]
        Beyond it no row: so far sideways lies another part, or another person.
    chosen : (N,) int64, optional
        To be filled with the cell that every sample is drawn to, -1 for none; see `FreeSpace.middle`.
    """
    check_depth_image(space.depth, camera)
    sigma = 10.0 * space.cell if sigma is None else sigma
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of free space is {sigma} px", remedy="Give a positive one.")
    data, segment, group = _kernels.buffers(len(samples))
    chosen = np.empty(len(samples), np.int64) if chosen is None else chosen
    end = kernels.free_space_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, space.depth, space.nearest,
        space.missing, space.cell, tolerance, reach, 1.0 / sigma**2, chosen, data, segment, group, 0,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])
