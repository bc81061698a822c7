"""From a take file to a motion."""

from __future__ import annotations

from os import PathLike

from kinefit.bodies import load_body
from kinefit.errors import TakeError
from kinefit.motion import Motion
from kinefit.readers.load import Observations, load_observations
from kinefit.readers.take import Take, read_take
from kinefit.tracking.tracker import Settings
from kinefit.tracking.video import Progress, track


def track_take(
    take: Take | str | PathLike[str], *, settings: Settings | None = None, progress: Progress | None = None
) -> tuple[Motion, Observations]:
    """Track the person of a take file.

    Returns the motion and what the sensors saw (for overlays).

    Raises
    ------
    TakeError
        The take has no keypoints.
    KinefitError
        What reading and tracking raise.
    """
    take = take if isinstance(take, Take) else read_take(take)
    body = load_body(take.body)
    observations = load_observations(take)
    if not observations.keypoints or observations.rig is None:
        raise TakeError(
            "the take has no [[keypoints]]",
            file=take.path,
            remedy="Tracking needs 2D keypoints of two or more cameras.",
        )
    motion = track(
        observations.rig,
        observations.keypoints,
        body,
        accuracy=[entry.accuracy for entry in take.keypoints],
        settings=settings,
        height=take.height,
        up=take.up,
        name=take.name,
        progress=progress,
    )
    return motion, observations
