"""From a take file to a motion."""

from __future__ import annotations

from os import PathLike

from kinefit.bodies import load_body
from kinefit.errors import TakeError
from kinefit.motion import Motion
from kinefit.multiview.association import choose_people
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.sensors.channels import make_channels
from kinefit.subject.keypoints import Subject, fit_subject
from kinefit.tracking.fusion_take import fuse_take
from kinefit.tracking.tracker import Settings
from kinefit.tracking.video import Progress, track


def track_take(
    take: Take | str | PathLike[str], *, smooth: bool = True, contacts: bool = False, settings: Settings | None = None,
    progress: Progress | None = None,
) -> tuple[Motion, Observations]:
    """Track the person of a take file; `smooth` and `contacts` as in `track`.

    A take with depth, stereo, silhouettes or markers is fused frame by frame from all of its sensors (`fuse_take`),
    any other is fitted to the keypoints of its cameras.

    Returns the motion and what the sensors saw (for overlays).

    Raises
    ------
    TakeError
        The take has no keypoints, or its subject's trial has another body.
    KinefitError
        What reading and tracking raise.
    """
    take = take if isinstance(take, Take) else read_take(take)
    if take.depth or take.stereo or take.silhouettes or take.markers:
        observations = load_observations(take)
        return fuse_take(take, observations, progress=progress), observations
    body, observations = load_body(take.body), load_keypoints(take)
    assert observations.rig is not None
    motion = track(
        observations.rig,
        observations.keypoints,
        body,
        accuracy=[entry.sigma for entry in take.keypoints],
        trial=trial_of(take),
        contacts=contacts,
        smooth=smooth,
        settings=settings,
        height=take.height,
        up=take.up,
        name=take.name,
        progress=progress,
    )
    return motion, observations


def load_keypoints(take: Take, *, exteriors: bool = True) -> Observations:
    """What the sensors of a take saw, keypoints of cameras among it; `exteriors` as in `load_observations`."""
    observations = load_observations(take, exteriors=exteriors)
    if not observations.keypoints or observations.rig is None:
        raise TakeError(
            "the take has no [[keypoints]]",
            file=take.path,
            remedy="Tracking needs 2D keypoints of two or more cameras: `kinefit detect` finds them in its videos.",
        )
    return observations


def trial_of(take: Take, *, frames: int = 50) -> Subject | None:
    """The person as another trial shows it, where a take names one (`subject`)."""
    if take.subject is None:
        return None
    trial = read_take(take.subject)
    if trial.body != take.body:
        raise TakeError(
            f"the subject's trial has the body {trial.body}, the take {take.body}", file=take.path,
            place="[take] subject", remedy="Use the same body in both.",
        )
    seen, body = load_keypoints(trial), load_body(take.body)
    assert seen.rig is not None
    accuracy = [entry.sigma for entry in trial.keypoints]
    channels = make_channels(body, seen.rig, seen.keypoints, choose_people(seen.rig, seen.keypoints), accuracy)
    return fit_subject(body, channels, frames=frames, height=trial.height or take.height)
