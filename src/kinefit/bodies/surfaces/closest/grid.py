"""Signed distance grids of meshes, and a table of all grids of a body for the search kernel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.closest import _kernels_grid as kernels

GRID_CELLS = 64  # along the longest side: 1 cm for a limb. Finer ones gain less than a sensor's noise
MARGIN = 0.15  # [m] around the surface; farther points are extrapolated


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distance to a surface at the nodes of a grid: positive outside, negative inside.

    Parameters
    ----------
    origin : (3,) [m] the first node, in the surface's frame.
    cell : float [m]
    values : (X, Y, Z, 4) float32, distance [m] and its gradient.
    lower, upper : (3,) [m] the box of the surface itself.
    """

    origin: NDArray
    cell: float
    values: NDArray
    lower: NDArray
    upper: NDArray

    def scaled(self, factor: float) -> DistanceGrid:
        """Grid of the surface scaled about its frame's origin by a factor, a number > 0."""
        values = self.values.copy()
        values[..., 0] *= factor
        return DistanceGrid(
            self.origin * factor, self.cell * factor, values, self.lower * factor, self.upper * factor
        )


def distance_grid(
    vertices: NDArray, faces: NDArray, *, cells: int = GRID_CELLS, margin: float = MARGIN
) -> DistanceGrid:
    """Signed distance grid of a closed mesh; intersecting parts count as their union.

    Distances are exact near the surface. Elsewhere sweeps propagate the nearest triangle, which is refined among its
    neighbours. The sign is that of the angle-weighted normal of the closest face, edge or corner (Baerentzen & Aanaes
    2005), so that small holes are bridged.

    Parameters
    ----------
    vertices : (V, 3) [m]; faces : (T, 3) int, outward counter-clockwise, corners shared between neighbours.
    cells : int, along the longest side with its margin.
    margin : float [m] around the surface.
    """
    vertices = np.ascontiguousarray(vertices, float)
    used = vertices[faces]
    lower, upper = used.min((0, 1)), used.max((0, 1))
    cell = cell_size(used, cells, margin)
    size = np.ceil((upper - lower + 2.0 * margin) / cell).astype(int) + 1
    origin = 0.5 * (lower + upper) - 0.5 * cell * (size - 1)
    values = np.full((*size, 4), np.inf, np.float32)
    for part in parts(faces):
        corners, (features, across) = np.ascontiguousarray(used[part]), features_of(vertices, faces[part])
        squared, owner = np.full(size, np.inf), np.full(size, -1, np.int32)
        kernels.seed(corners, origin, cell, 1.5 * cell, squared, owner)
        kernels.sweep(corners, origin, cell, squared, owner)
        kernels.walk(corners, across, origin, cell, squared, owner)
        kernels.finish(corners, features, origin, cell, owner, values)
    values.flags.writeable = False
    return DistanceGrid(origin, cell, values, lower, upper)


def cell_size(corners: NDArray, cells: int = GRID_CELLS, margin: float = MARGIN) -> float:
    """Side [m] of the cells of `distance_grid` around corners (T, 3, 3) [m]."""
    x = corners.reshape(-1, 3)
    return float((x.max(0) - x.min(0)).max() + 2.0 * margin) / cells


def parts(faces: NDArray) -> list[NDArray]:
    """Connected parts of faces (T, 3) or edges (E, 2): indices of each; faces that share a corner are connected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, others = np.repeat(faces[:, 0], faces.shape[1] - 1), faces[:, 1:].ravel()
    joins = coo_array((np.ones(len(first), bool), (first, others)), shape=(int(faces.max()) + 1,) * 2)
    of_face = connected_components(joins, directed=False)[1][faces[:, 0]]
    return [np.flatnonzero(of_face == name) for name in np.unique(of_face)]


def features_of(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Normals (T, 7, 3) of each face, its three corners and edges ab, bc, ca; and the faces (T, 3) across these edges.

    Normals of corners are weighted by angles (Baerentzen & Aanaes 2005). Across an open edge is the face itself.
    """
    corners = vertices[faces]
    sides = np.roll(corners, -1, 1) - corners  # ab, bc, ca
    normal = np.cross(sides[:, 0], -sides[:, 2])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    unit = sides / np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-30)
    angles = np.arccos(np.clip(-np.einsum("tki,tki->tk", unit, np.roll(unit, 1, 1)), -1.0, 1.0))
    at_vertex = np.zeros_like(vertices)
    np.add.at(at_vertex, faces, angles[:, :, None] * normal[:, None])
    ends = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2), axis=2).reshape(-1, 2)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    at_edge = np.zeros((int(edge.max()) + 1, 3))
    np.add.at(at_edge, edge.ravel(), np.repeat(normal, 3, axis=0))
    half = np.argsort(edge.ravel(), kind="stable")  # sides of faces, those of one edge adjacent
    pairs = np.flatnonzero(np.diff(edge.ravel()[half]) == 0)
    across = np.repeat(np.arange(len(faces)), 3)
    across[half[pairs]], across[half[pairs + 1]] = half[pairs + 1] // 3, half[pairs] // 3
    out = np.concatenate([normal[:, None], at_vertex[faces], at_edge[edge.reshape(-1, 3)]], axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=2, keepdims=True), 1e-30), across.reshape(-1, 3)
