"""What to take for depth, alone or with anything else: P2's fusion with hard joints instead of elastic bands.

Beside the method as printed (`recipes.voodoo`) it has: a tree of joints with limits; measured points to the surface
along its normal, and the surface that the camera can see to what was measured at its pixels; robust weights that
tighten; free space; parts that keep out of each other; a prediction with its uncertainty; a background that is learnt;
limbs that are noticed when they are lost, and sought; the person's own size; a start with no pose given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kinefit._arguments import renamed
from kinefit.bodies import Body, BodyState
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion
from kinefit.observations import Frame
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.subject import Progress
from kinefit.tracking.recording import Recording
from kinefit.tracking.video import track


@renamed(accuracy="sigma")
def depth_fusion(
    steps: Sequence[Sequence[Frame]],
    body: Body,
    rig: Rig,
    *,
    rate: float,
    sigma: Mapping[str, float] | None = None,
    up: str = "z",
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
    sigma : {sensor: standard deviation}, [m] of depth, clouds and markers, [px] of keypoints.
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
    recording = Recording.of_frames(
        steps, rig, rate=rate, sigma=sigma, up=up, start=None if start is None else (0, start)
    )
    return track(recording, body, size=size and start is None, smooth=False, settings=settings, progress=progress)
