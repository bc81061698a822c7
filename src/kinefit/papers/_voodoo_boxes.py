"""Bounding boxes of the body and its limbs, to assign measured points (P2 4.2.1 and 4.2.2)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, TaperedCylinder
from kinefit.bodies.surfaces import bounding_box

Overlap = Literal["shared", "exclusive", "adjacent"]


class Boxes(NamedTuple):
    """Bounding boxes of all surfaces, B of them, in the root frame at rest.

    limb (B,) int; centre (B, 3) [m]; axes (B, 3, 3) rows; half (B, 3) [m]; adjacent (S, S) bool, limbs with a joint.
    """

    limb: NDArray
    centre: NDArray
    axes: NDArray
    half: NDArray
    adjacent: NDArray


def boxes_of(body: Body) -> Boxes:
    """Boxes of a body's surfaces: along the axes of a cylinder, along the segment's for a mesh."""
    limb, centre, axes, half = [], [], [], []
    for surface in body.surfaces:
        if isinstance(surface, TaperedCylinder):
            box = bounding_box(surface)
            middle, along, size = box.centre, box.axes, box.half
        else:
            low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
            middle, along, size = 0.5 * (low + high), np.eye(3), 0.5 * (high - low)
        limb.append(surface.segment)
        centre.append(middle + body.tree.rest[surface.segment])
        axes.append(along)
        half.append(size)
    adjacent = np.eye(len(body.tree.segments), dtype=bool)
    for s, parent in enumerate(body.tree.parents):
        if parent >= 0:
            adjacent[s, parent] = adjacent[parent, s] = True
    shape = len(limb)
    return Boxes(
        np.array(limb, np.int64), np.reshape(centre, (shape, 3)), np.reshape(axes, (shape, 3, 3)),
        np.reshape(half, (shape, 3)), adjacent,
    )  # fmt: skip


def in_body_box(x: NDArray, boxes: Boxes, frames: NDArray, enlargement: float) -> NDArray:
    """Step 1: whether points (N, 3) [m] lie in the enlarged [m] axis-aligned box of the whole body: (N,) bool."""
    R, t = frames[boxes.limb, :9].reshape(-1, 3, 3), frames[boxes.limb, 9:]
    centre = (R @ boxes.centre[:, :, None])[..., 0] + t
    reach = np.einsum("bij,bkj,bk->bik", R, boxes.axes, boxes.half)  # (B, world axis, edge of the box)
    half = np.abs(reach).sum(axis=2)
    low, high = (centre - half).min(axis=0) - enlargement, (centre + half).max(axis=0) + enlargement
    u, v, w = x.T
    inside: NDArray = (
        (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1]) & (w >= low[2]) & (w <= high[2])
    )
    return inside


def depth_in_boxes(x: NDArray, boxes: Boxes, frames: NDArray, enlargement: float) -> NDArray:
    """Step 2: depth (N, S) [m] of each point in each limb's enlarged box; negative outside, -inf without a box."""
    R, t = frames[boxes.limb, :9].reshape(-1, 3, 3), frames[boxes.limb, 9:]
    turn = R @ boxes.axes.swapaxes(1, 2)  # (B, 3, 3) from the box to the world
    middle = np.einsum("bij,bj->bi", R, boxes.centre) + t
    local = (x @ turn.transpose(1, 0, 2).reshape(3, -1)).reshape(len(x), len(turn), 3)  # all boxes in one product
    room = boxes.half + enlargement - np.abs(local - np.einsum("bi,bij->bj", middle, turn))
    deep = np.minimum(np.minimum(room[..., 0], room[..., 1]), room[..., 2])
    out = np.full((len(x), len(frames)), -np.inf)
    for b, limb in enumerate(boxes.limb):
        np.maximum(out[:, limb], deep[:, b], out=out[:, limb])
    return out


def assigned(depth: NDArray, boxes: Boxes, overlap: Overlap) -> NDArray:
    """Step 2: candidate limbs (N, S) bool of each point, by the rule for points in several boxes.

    shared: all of them; exclusive: the limb in whose box the point lies deepest; adjacent: that limb, and those joined
    to it.
    """
    inside = depth >= 0.0
    if overlap == "shared":
        return inside
    deepest = np.argmax(depth, axis=1)
    if overlap == "adjacent":
        return inside & boxes.adjacent[deepest]
    only = np.zeros_like(inside)
    only[np.arange(len(depth)), deepest] = True
    return inside & only
