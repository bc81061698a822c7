"""A body whose parts move freely: for the elastic model, whose joints are bands (P2 3.4)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.state import BodyState
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError
from kinefit.geometry import se3

_SLIDES = ("tx", "ty", "tz")
_TURNS = ("rz", "rx", "ry")  # in this order the gimbal lock is at an arm raised sideways
_AXES = np.concatenate([np.eye(3), np.eye(3)[[2, 0, 1]]])


def free_parts(body: Body) -> Body:
    """Cut a body at its joints: every part has six degrees of freedom, three translations and three rotations.

    Segments keep their indices, names, surfaces and points, and all become children of the first.
    `correspondences.band_rows` replaces the joints.
    """
    tree, count = body.tree, len(body.tree.segments)
    free = 6 * (count - 1)
    return replace(
        body,
        name=f"{body.name}_parts",
        tree=KinematicTree(
            segments=tree.segments,
            parents=np.append(-1, np.zeros(count - 1, int)),
            offsets=np.concatenate([tree.rest[:1], tree.rest[1:] - tree.rest[0]]),
            coordinates=tuple(f"{name}_{axis}" for name in tree.segments[1:] for axis in _SLIDES + _TURNS),
            owners=np.repeat(np.arange(1, count), 6),
            axes=np.tile(_AXES, (count - 1, 1)),
            prismatic=np.tile([True] * 3 + [False] * 3, count - 1),
            lower=np.full(free, -np.inf),
            upper=np.full(free, np.inf),
            usual=np.zeros(free),
            spread=np.full(free, np.inf),
        ),
    )


def parts_state(parts: Body, frames: NDArray) -> BodyState:
    """State of a body of free parts from its segments' frames (S, 12), see `KinematicTree.forward`.

    Raises
    ------
    BodyError
        Frames of another number of segments.
    """
    count = len(parts.tree.segments)
    if frames.shape != (count, 12) or len(parts.tree.coordinates) != 6 * (count - 1):
        problem = f"frames of shape {frames.shape} for {count} segments, {len(parts.tree.coordinates)} angles"
        raise BodyError(problem, remedy="Give `free_parts(body)`, and frames (segments, 12).")
    R, t = frames[:, :9].reshape(-1, 3, 3), frames[:, 9:]
    rest, root = parts.tree.rest, R[0]
    joints = (R @ rest[:, :, None])[..., 0] + t
    slides = (joints[1:] - t[0]) @ root - rest[1:]
    turned = root.T @ R[1:]
    sine = np.clip(turned[:, 2, 1], -1.0, 1.0)  # R = Rz(a) Rx(b) Ry(c)
    a, b = np.arctan2(-turned[:, 0, 1], turned[:, 1, 1]), np.arcsin(sine)
    c = np.arctan2(-turned[:, 2, 0], turned[:, 2, 2])
    locked = np.abs(sine) > 1.0 - 1e-12  # gimbal lock: a and c rotate about one axis
    a = np.where(locked, np.arctan2(turned[:, 1, 0], turned[:, 0, 0]), a)
    c = np.where(locked, 0.0, c)
    return BodyState(se3.transform(root, joints[0]), np.column_stack([slides, a, b, c]).ravel())
