"""VooDoo: sensors fused in one fit of a body whose joints are elastic bands.

Knoop, Vacek, Dillmann, "Sensor fusion for 3D human body tracking with an articulated 3D body model", ICRA 2006 (P2).
As printed: every limb moves by its own closed form (Horn) to what is nearest to it, and bands hold the limbs together.
`recipes.depth_fusion` is what to use; this is what it is compared with.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.bands import Bands, joint_bands
from kinefit.geometry.camera import Rig
from kinefit.observations import Frame
from kinefit.recipes import _voodoo_boxes as boxing
from kinefit.recipes import _voodoo_steps as steps
from kinefit.recipes._voodoo_input import Sight, sight_of
from kinefit.solvers.limbs import absolute_orientation, move


@dataclass(frozen=True)
class Settings:
    """The parameters that P2 names; lengths in metres.

    Parameters
    ----------
    weights : sensor or feature -> weight
        A feature's counts before its sensor's; 1 for what is not named (P2 5: ToF 1, face 30, hands 20).
    body_box, limb_box : float
        Enlargement of the box of the whole body, and of every limb's: how far a limb moves from frame to frame.
    overlap : "shared", "exclusive" or "adjacent", for points in the boxes of several limbs.
    factor, minimum, maximum : sampling factor, and points of a limb at least and at most.
    bound : float
        Pairs that are farther apart do not count.
    band : float
        Weight of a band: about that of the points of half a limb.
    stay : float [m²]
        See `absolute_orientation`: a limb seen by one feature does not spin about it.
    quality : float [m²]
        Mean squared distance that is good enough.
    steps : int, at most.
    """

    weights: Mapping[str, float] = field(default_factory=lambda: {"nose_tip": 30.0, "l_wrist": 20.0, "r_wrist": 20.0})
    body_box: float = 0.1
    limb_box: float = 0.1
    overlap: boxing.Overlap = "exclusive"
    factor: float = 1.0
    minimum: int = 40
    maximum: int = 100
    bound: float = 0.15
    band: float = 30.0
    stay: float = 0.1
    quality: float = 0.005**2
    steps: int = 15


class Fit(NamedTuple):
    """One frame: frames (S, 12) of the limbs, the mean squared distance [m²] left, and the steps that were done."""

    frames: NDArray
    quality: float
    steps: int


def voodoo(
    stream: Iterable[Sequence[Frame]], body: Body, start: BodyState, rig: Rig, settings: Settings | None = None
) -> Iterator[Fit]:
    """Track a body from frame to frame; each starts where the one before ended.

    Parameters
    ----------
    stream : for each time, what the sensors saw.
    body : Body with surfaces.
    start : BodyState of the body (its joints closed) just before the first frame.
    rig : Rig of the cameras named in the frames.
    """
    s = settings or Settings()
    frames, _ = body.tree.forward(start.T_world_root, start.angles)
    boxes, bands = boxing.boxes_of(body), joint_bands(body)
    for seen in stream:
        fit = fit_frame(body, frames, sight_of(seen, body, rig, s.weights), boxes, bands, s)
        frames = fit.frames
        yield fit


def fit_frame(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, bands: Bands, s: Settings) -> Fit:
    """Steps 1 to 7, until the quality is met or the steps are spent (P2 4.2, fig. 3)."""
    pairs, step = _pairs(body, frames, sight, boxes, bands, s), 0
    while step < s.steps and steps.quality(pairs) > s.quality:
        frames = move(frames, *absolute_orientation(*pairs, count=len(frames), stay=s.stay))
        pairs, step = _pairs(body, frames, sight, boxes, bands, s), step + 1
    return Fit(frames, steps.quality(pairs), step)


def _pairs(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, bands: Bands, s: Settings) -> steps.Pairs:
    """Steps 1 to 6: everything that pulls at a limb."""
    return steps.joined(
        _points(body, frames, sight, boxes, s),
        steps.points_on_points(body, frames, sight.points, sight.places, sight.places_weight),
        steps.points_on_lines(body, frames, sight.features, sight.lines, sight.lines_weight),
        steps.band_pairs(body, frames, bands, s.band),
    )


def _points(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, s: Settings) -> steps.Pairs:
    """Steps 1 to 4 for free points, those on the body, and those on one limb, which skip what is known of them."""
    near = boxing.in_body_box(sight.free, boxes, frames, s.body_box)
    x = np.concatenate([sight.free[near], sight.on_body])
    weight = np.concatenate([sight.free_weight[near], sight.on_body_weight])
    member = boxing.assigned(boxing.depth_in_boxes(x, boxes, frames, s.limb_box), boxes, s.overlap)
    known = np.zeros((len(sight.on_limb), len(frames)), bool)
    known[np.arange(len(known)), sight.limb] = True
    x = np.concatenate([x, sight.on_limb])
    weight = np.concatenate([weight, sight.on_limb_weight])
    member = np.concatenate([member, known])
    point, limb = steps.fewer(member, factor=s.factor, minimum=s.minimum, maximum=s.maximum)
    return steps.closest_points(body, frames, x[point], weight[point], limb, s.bound)
