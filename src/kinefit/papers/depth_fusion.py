"""The recommended method for depth, alone or with other sensors: P2's fusion with hard joints instead of elastic bands.

Compared with the published method (`recipes.voodoo`) it has: a tree of joints with limits; measured points to the
surface along its normal, and the visible surface to the measurement at its pixel; robust weights that tighten; free
space; self-collisions; a prediction with its uncertainty; background subtraction; detection of lost limbs, and a search
for them; the person's own size; initialisation without a given pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kinefit._arguments import renamed
from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import Motion
from kinefit.fitting import Recording, track
from kinefit.fitting.subject.subject import Progress
from kinefit.geometry.camera import Rig
from kinefit.observations import Frame
from kinefit.sensors.settings import TrackSettings


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
    """Estimate the motion of a person from the frames of any sensors.

    Parameters
    ----------
    steps : frames of all sensors at each time: depth images, clouds, keypoints and markers in any mix.
    body : Body with surfaces; of the catalogue if `size` fits it to the person.
    rig : Rig of all cameras, including depth cameras.
    rate : float [Hz] of the steps
    sigma : {sensor: standard deviation}, [m] of depth, clouds and markers, [px] of keypoints.
    up : vertical axis of the world
    start : state of the first step; default: estimated.
    size : bool, whether to estimate the person's size from the first depth images (some seconds of one core each).
    settings : TrackSettings
    progress : callable

    Raises
    ------
    ObservationError
        No steps, or steps without any frame.
    TrackingError
        The body is detected in none of the first steps.
    """
    recording = Recording.of_frames(
        steps, rig, rate=rate, sigma=sigma, up=up, start=None if start is None else (0, start)
    )
    return track(recording, body, size=size and start is None, smooth=False, settings=settings, progress=progress)
