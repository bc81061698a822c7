"""The one look of a body: which segment each triangle of its skin shows, and how lost and uncertain ones are drawn.

Viewer, report and live page draw a person by these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.motion import BELIEVED
from kinefit.rendering.colours import LOST_COLOUR, quality_ramp, side_colour
from kinefit.rendering.tubes import TubeMesh

LOST_OPACITY, UNCERTAIN_OPACITY = 0.45, 0.6
"""Of the skin of segments that no measurement supports, and of those whose place is uncertain."""

_MAX_SIGMA = 0.11  # [m] of a joint, all directions together, above which its limb may lie beside itself


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (V, 3) [m], faces (T, 3) int, counterclockwise from outside."""

    vertices: NDArray
    faces: NDArray


@dataclass(frozen=True, eq=False)
class SkinPiece:
    """The part of a skin that one segment carries.

    Parameters
    ----------
    segment : int
    mesh : Mesh, its vertices in the root's frame at rest
    followed : (B,) int, segments that its vertices follow
    weights : (V, B) how much each vertex follows these; they sum to 1
    """

    segment: int
    mesh: Mesh
    followed: NDArray
    weights: NDArray


def triangle_segments(skin: TubeMesh) -> NDArray:
    """(T,) int: the segment that each triangle belongs to, the one that the ends of its longest edge follow most.

    Both halves of a quadrilateral share this edge, so borders have no teeth.
    """
    every = np.zeros((len(skin.vertices), int(skin.segments.max(initial=-1)) + 1))
    np.add.at(every, (np.arange(len(every))[:, None], skin.segments), skin.weights)
    corners = skin.vertices[skin.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    rows = np.arange(len(longest))
    ends = [skin.triangles[rows, (longest + k) % 3] for k in range(2)]
    return np.asarray((every[ends[0]] + every[ends[1]]).argmax(axis=1) if len(rows) else rows)


def skin_pieces(skin: TubeMesh) -> list[SkinPiece]:
    """A skin cut along the borders of the segments (`triangle_segments`)."""
    owners = triangle_segments(skin)
    out = []
    for s in np.unique(owners):
        used, faces = np.unique(skin.triangles[owners == s], return_inverse=True)
        segments, shares = skin.segments[used], skin.weights[used]
        followed, columns = np.unique(np.where(shares > 0, segments, s), return_inverse=True)
        weights = np.zeros((len(used), len(followed)))
        np.add.at(weights, (np.arange(len(used))[:, None], columns.reshape(shares.shape)), shares)
        out.append(SkinPiece(int(s), Mesh(skin.vertices[used], faces.reshape(-1, 3)), followed, weights))
    return out


def side_colours(body: Body) -> NDArray:
    """(S, 3) uint8: left blue, right orange, the middle green."""
    return np.array([side_colour(name) for name in body.tree.segments], np.uint8).reshape(-1, 3)


def segment_looks(
    quality: NDArray, base_colours: NDArray, *, by_quality: bool, uncertain: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Colours (S, 3) uint8 and opacities (S,) of the segments by their quality (S,) in 0..1.

    A segment that is lost is grey and translucent whatever the colours mean; one that is `uncertain` (S,) bool is a
    little translucent.
    """
    lost = np.asarray(quality) < BELIEVED
    colours = quality_ramp(1.0 - np.asarray(quality, float)) if by_quality else base_colours
    opacities = np.where(False if uncertain is None else uncertain, UNCERTAIN_OPACITY, 1.0)
    shades = np.where(lost[:, None], np.array(LOST_COLOUR, np.uint8), colours)
    return shades, np.where(lost, LOST_OPACITY, np.broadcast_to(opacities, lost.shape))


def uncertain_segments(body: Body, joint_std: NDArray) -> NDArray:
    """(..., S) bool: segments of which a joint, at either end, has sigmas (..., S, 3) [m] above 11 cm in all."""
    sigmas = np.sqrt(np.sum(np.square(np.nan_to_num(joint_std, nan=np.inf, posinf=np.inf)), axis=-1))
    out, parents = sigmas > _MAX_SIGMA, body.tree.parents
    np.logical_or.at(out.T, parents[parents >= 0], (sigmas > _MAX_SIGMA).T[parents >= 0])
    return out
