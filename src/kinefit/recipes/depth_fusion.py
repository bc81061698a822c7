"""What to take for depth, alone or with anything else: P2's fusion with hard joints instead of elastic bands.

Beside the method as printed (`recipes.voodoo`) it has: a tree of joints with limits; measured points to the surface
along its normal, and the surface that the camera can see to what was measured at its pixels; robust weights that
tighten; free space; parts that keep out of each other; a prediction with its uncertainty; a background that is learnt;
limbs that are noticed when they are lost, and sought; the person's own size; a start with no pose given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.motion import UP_AXES, Motion
from kinefit.observations import DepthFrame, Frame
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.keypoints import Progress
from kinefit.tracking.fusion import FusionTracker
from kinefit.tracking.fusion_run import Sized, run_steps, sized_by_depth

_SIZES = 4  # depth images that the person's size is found from ...
_FIRST = 150  # ... among so many first ones


def depth_fusion(
    steps: Sequence[Sequence[Frame]],
    body: Body,
    rig: Rig,
    *,
    rate: float,
    accuracy: Mapping[str, float] | None = None,
    up: str = "y",
    start: BodyState | None = None,
    size: bool = True,
    settings: TrackSettings | None = None,
    progress: Progress | None = None,
) -> Motion:
    """Motion of a person from what any sensors saw, step by step.

    Parameters
    ----------
    steps : of frames: what the sensors saw at each time; depth images, clouds, keypoints and markers in any mix.
    body : Body with surfaces; of the catalogue, where `size` fits it to the person.
    rig : Rig of all cameras, depth cameras among them.
    rate : float [Hz] of the steps
    accuracy : {sensor: standard deviation}, [m] of depth, clouds and markers, [px] of keypoints.
    up : vertical axis of the world
    start : state of the first step; default: sought.
    size : whether the person's size is found from the first depth images (some seconds of one core each).
    settings : TrackSettings

    Raises
    ------
    ObservationError
        No steps, or steps without any frame.
    TrackingError
        The body is found in none of the first steps.
    """
    times = [float(np.mean([f.time for f in seen])) if len(seen) else np.nan for seen in steps]
    known = np.flatnonzero(np.isfinite(times))
    if not len(known):
        raise ObservationError("no step with a frame", remedy="Give what the sensors saw, a list of frames a step.")
    times = np.interp(np.arange(len(times)), known, np.array(times)[known])
    found = Sized(body, None if start is None else (0, start))
    if size and start is None:
        found = _sized(steps, body, rig, np.array(UP_AXES[up]), progress)
    tracker = FusionTracker(found.body, rig, rate=rate, accuracy=accuracy, up=UP_AXES[up], settings=settings)
    return run_steps(
        tracker, lambda i: steps[i], times, up=up, start=found.start, provenance=found.told, progress=progress
    )


def _sized(
    steps: Sequence[Sequence[Frame]], body: Body, rig: Rig, up: np.ndarray, progress: Progress | None
) -> Sized:
    """The body in the person's size, from images of the depth camera that comes first."""
    shown = {i: f for i, seen in enumerate(steps[:_FIRST]) for f in seen if isinstance(f, DepthFrame)}
    sensor = next((f.sensor for f in shown.values()), None)
    mine = [i for i, f in shown.items() if f.sensor == sensor]
    if sensor is None:
        return Sized(body)
    if progress:
        progress("size", 0, 1)
    chosen = {mine[k]: shown[mine[k]] for k in np.linspace(0, len(mine) - 1, min(_SIZES, len(mine))).astype(int)}
    return sized_by_depth(body, chosen, rig[sensor], up)
