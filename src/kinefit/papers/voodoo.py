"""VooDoo: sensors fused in one fit of a body whose joints are elastic bands.

Knoop, Vacek, Dillmann, "Sensor fusion for 3D human body tracking with an articulated 3D body model", ICRA 2006 (P2).
Every limb moves by its own closed form (Horn) towards its nearest measurements, and bands connect the limbs.
Use `recipes.depth_fusion`; this is the method that it is compared with.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.geometry.camera import Rig
from kinefit.observations import Frame
from kinefit.papers import _voodoo_boxes as boxing
from kinefit.papers import _voodoo_motion as motion
from kinefit.papers import _voodoo_steps as steps
from kinefit.papers._voodoo_input import Sight, near_body, sight_of
from kinefit.papers._voodoo_steps import LimbFit
from kinefit.solving.correspondences.closures import Bands, joint_bands

_MAX_MOTION = 0.5  # [m] of a limb from frame to frame
_HANDS = ("l_wrist", "r_wrist", "l_metacarpal_phalanx_3", "r_metacarpal_phalanx_3")
_WEIGHTS = {"nose_tip": 30.0, **dict.fromkeys(_HANDS, 20.0)}  # of the face and the hands (P2 5)


@dataclass(frozen=True)
class Settings:
    """The parameters that P2 names; lengths in metres.

    Parameters
    ----------
    weights : sensor or feature -> weight
        A feature's weight overrides its sensor's; default 1.
    body_box, limb_box : float
        Enlargement of the box of the whole body, and of every limb: the motion from frame to frame.
    overlap : "shared", "exclusive", "adjacent" or "nearest", for points in the boxes of several limbs.
        "exclusive" is by depth in the boxes; "nearest", by distance to the surface, is not in the paper.
    factor, minimum, maximum : sampling factor, and smallest and largest number of points of a limb.
    bound : float
        Largest distance of a pair.
    band : float
        Weight of each band; with the rule "points", of all bands of a limb relative to its points (at least `minimum`).
    band_rule : "each" or "points"
    ranges : float
        Weight of artificial correspondences that pull a limb back into the range of its joint (P2 6); default: none.
    floor : (4,) plane a, b, c, d with a x + b y + c z = d [m], optional
        Free points less than `clear` [m] above it are ignored.
    down : bool
        Whether a limb's motion is applied to its descendants, from the root on, before theirs are estimated.
    stay : float [m²]
        See `absolute_orientation`: keeps a limb with one feature from rotating about it.
    quality : float [m²]
        Mean squared distance at which the iteration ends.
    stop : float [m²], optional
        ICP's own rule: end if the last step lowered the mean squared distance by less (P2 3.2).
    steps : (int, int) smallest and largest number.
    """

    weights: Mapping[str, float] = field(default_factory=lambda: dict(_WEIGHTS))
    body_box: float = 0.1
    limb_box: float = 0.1
    overlap: boxing.Overlap | Literal["nearest"] = "nearest"
    factor: float = 1.0
    minimum: int = 40
    maximum: int = 400
    bound: float = 0.15
    band: float = 30.0
    band_rule: Literal["each", "points"] = "each"
    ranges: float = 0.0
    floor: tuple[float, float, float, float] | None = None
    clear: float = 0.05
    down: bool = True
    stay: float = 0.1
    quality: float = 0.005**2
    stop: float | None = None
    steps: tuple[int, int] = (0, 15)


def voodoo(
    stream: Iterable[Sequence[Frame]], body: Body, start: BodyState, rig: Rig, settings: Settings | None = None
) -> Iterator[LimbFit]:
    """Track a body frame by frame, each from the last result.

    Parameters
    ----------
    stream : frames of the sensors for each time.
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


def fit_frame(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, bands: Bands, s: Settings) -> LimbFit:
    """Fit frames (S, 12) by steps 1 to 7, until quality, ICP's rule or the largest number of steps (P2 4.2, fig. 3)."""
    sight = near_body(sight, boxes, frames, s.body_box + _MAX_MOTION, s.floor, s.clear)
    (least, most), step, before = s.steps, 0, np.inf
    measured, ends = _measured(body, frames, sight, boxes, s), motion.band_ends(body, frames, bands)
    while True:
        own, other = motion.band_weights(bands, measured, s.band, s.minimum if s.band_rule == "points" else None)
        now = steps.quality(steps.joined(measured, *motion.band_pairs(bands, ends, own, other)))
        if step == most or (step >= least and (now <= s.quality or (s.stop is not None and before - now < s.stop))):
            return LimbFit(frames, now, step)
        moved = motion.moved_down if s.down else motion.moved
        frames = moved(body, frames, measured, bands, ends, own, other, s.stay)
        measured, ends = _measured(body, frames, sight, boxes, s), motion.band_ends(body, frames, bands)
        step, before = step + 1, now


def _measured(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, s: Settings) -> steps.Pairs:
    """Steps 1 to 5: pairs of all measurements with points of the limbs, and of ranges where they have a weight."""
    return steps.joined(
        *([motion.range_pairs(body, frames, s.ranges)] if s.ranges else []),
        _points(body, frames, sight, boxes, s),
        steps.points_on_points(body, frames, sight.points, sight.places, sight.places_weight),
        steps.points_on_lines(body, frames, sight.features, sight.lines, sight.lines_weight),
    )


def _points(body: Body, frames: NDArray, sight: Sight, boxes: boxing.Boxes, s: Settings) -> steps.Pairs:
    """Steps 1 to 4 for free points, those on the body, and those on one limb, without steps that are known."""
    near = boxing.in_body_box(sight.free, boxes, frames, s.body_box)
    x = np.concatenate([sight.free[near], sight.on_body])
    weight = np.concatenate([sight.free_weight[near], sight.on_body_weight])
    if s.overlap == "nearest":  # the enlarged box contains all points within limb_box of the surface
        member = steps.nearest_limb(body, frames, x, min(s.bound, s.limb_box))
    else:
        member = boxing.assigned(boxing.depth_in_boxes(x, boxes, frames, s.limb_box), boxes, s.overlap)
    known = np.zeros((len(sight.on_limb), len(frames)), bool)
    known[np.arange(len(known)), sight.limb] = True
    x = np.concatenate([x, sight.on_limb])
    weight = np.concatenate([weight, sight.on_limb_weight])
    member = np.concatenate([member, known])
    point, limb = steps.fewer(member, factor=s.factor, minimum=s.minimum, maximum=s.maximum)
    return steps.closest_points(body, frames, x[point], weight[point], limb, s.bound)
