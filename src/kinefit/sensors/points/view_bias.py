"""Bias by direction of view: how far beside its point of the body a detector puts a keypoint, seen from each side.

A detector puts a hip nearer to what it sees of the person: in front it is somewhere else on the body than from behind.
Of each keypoint that is a shift e [m] in the axes of the trunk, a function of the unit direction d from the point to
the camera in the same axes (x forward, y up, z to the right):

    e(d) = C^T phi(d),   phi(d) = (x, y, z, x^2 - z^2, x z)

Its constant part is where the point sits on the body (`PointOffsets`), and its part along the ray shows nowhere. Left
and right are mirror images: e_left(d) = M e_right(M d), M = diag(1, 1, -1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import KinematicTree
from kinefit.geometry.camera import Rig
from kinefit.sensors.channels import Channels
from kinefit.sensors.points import _kernels_view_bias as _kernels

TERMS = 5
MIRRORED = np.outer((1.0, 1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0))
"""(5, 3) signs of the coefficients of the point on the other side."""


def directions(d: NDArray) -> NDArray:
    """phi (..., 5) of unit directions (..., 3) in the trunk's axes."""
    x, z = d[..., 0], d[..., 2]
    return np.concatenate([d, (x * x - z * z)[..., None], (x * z)[..., None]], axis=-1)


def trunks(tree: KinematicTree) -> NDArray:
    """(S,) int: of every segment the nearest one from it to the root that is neither of the left nor of the right."""
    out = np.arange(len(tree.segments))
    for s, name in enumerate(tree.segments):
        if name.endswith(("_l", "_r")) and tree.parents[s] >= 0:
            out[s] = out[tree.parents[s]]
    return out


@dataclass(frozen=True, eq=False)
class ViewBias:
    """Biases of a detector's keypoints.

    Parameters
    ----------
    sets : {keypoint set: {point: (5, 3) [m] coefficients C in the axes of its trunk's segment}}
    followed : {keypoint set: {point: share 0..1 of its lasting errors that C follows in the take it was learnt from}}
    """

    sets: Mapping[str, Mapping[str, NDArray]] = field(default_factory=dict)
    followed: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def known_to(self, channels: Channels) -> Channels:
        """Channels that know it; the same where there is nothing to know."""
        if not self.sets:
            return channels
        bias, followed = np.zeros((len(channels.points), TERMS, 3)), np.zeros(len(channels.points))
        for name, span in channels.sets.items():
            known, share = self.sets.get(name, {}), self.followed.get(name, {})
            for k in range(span.start, span.stop):
                point = channels.points.names[k]
                bias[k], followed[k] = known.get(point, 0.0), share.get(point, 0.0)
        return replace(channels, view_bias=bias[channels.column], view_followed=followed[channels.column])

    def as_record(self) -> dict[str, Any]:
        """The same [m] as lists, for `Motion.provenance`."""
        return {s: {n: np.round(c, 5).tolist() for n, c in points.items()} for s, points in self.sets.items()}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> ViewBias:
        """Of what `as_record` gave."""
        return cls({s: {n: np.array(c, float) for n, c in points.items()} for s, points in record.items()})


def beside(
    coefficients: NDArray, trunk: NDArray, x_world: NDArray, frames: NDArray, rig: Rig, camera: NDArray
) -> NDArray:
    """(N, 2) [px] how far beside their points keypoints are seen; 0 where a point cannot be seen.

    Parameters
    ----------
    coefficients : (N, 5, 3) [m]
    trunk : (N,) segment in whose axes they are
    x_world : (N, 3) [m] the points
    frames : (S, 12) of the segments, rotation first
    camera : (N,) of the rig
    """
    moved = np.empty(x_world.shape)
    _kernels.shifted(coefficients, trunk, x_world, frames, rig.packed, camera, moved)
    out: NDArray = rig.project(moved, camera) - rig.project(x_world, camera)
    out[~np.isfinite(out)] = 0.0
    return out
