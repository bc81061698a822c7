"""From a recording of any sensors to a motion: the main job."""

from __future__ import annotations

from dataclasses import replace

from kinefit._arguments import checked
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError
from kinefit.fitting.smoothing.online.fixed_lag import lag_frames
from kinefit.fitting.smoothing.online.lag_frame import KnownNoise
from kinefit.fitting.subject.subject import Progress, Subject
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, TrackingInterrupted
from kinefit.fitting.tracking.marker_steps import fit_marker_steps
from kinefit.fitting.tracking.motions import Estimation, motion_of
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.run import run
from kinefit.fitting.tracking.sizing import SizedPerson, fitted_to_person
from kinefit.sensors.base import of_kind
from kinefit.sensors.settings import TrackSettings


@checked
def track(
    recording: Recording, body: Body, *, subject: Subject | None = None, trial: Subject | None = None,
    height: float | None = None, size: bool = True, settings: TrackSettings | None = None, smooth: bool = True,
    contacts: bool = False, lag: float | None = None, noise: KnownNoise | None = None, shape_frames: int | None = None,
    progress: Progress | None = None, checkpoint: Checkpoint | None = None,
) -> Motion:  # fmt: skip
    """Motion of one person from whatever sensors saw, with no pose given.

    The body is fitted to the person, every frame is fitted to all that was measured then, with outliers and exchanged
    sides set right, lost limbs sought; in the end all frames are fitted together with a motion prior whose process
    noise is estimated from the take.

    Parameters
    ----------
    recording : Recording
    body : Body, generic.
    subject : Subject
        Known already; default: fitted from this recording.
    trial : Subject
        Of another trial of the same person, from keypoints: the fit of this one starts from its lengths.
    height : float [m]
        Stature, where it is known: the length of bones that nobody sees follows it.
    size : whether the body is fitted to the person
    settings : TrackSettings
    smooth : bool
        Fit all frames together in the end; without it each frame knows only of those before it.
    contacts : bool
        Hold the soles still where they rest on a level floor, when smoothing.
    lag : float [s]
        Instead of smoothing the whole take: each frame as a live session has it so much later (`FixedLag`).
    noise : KnownNoise
        With a lag: process noise and the sensors' noise, of another take (`KnownNoise.of_take`); default:
        `KnownNoise.usual`.
    shape_frames : int, how many frames bone lengths are found from by keypoints of several cameras; default 25.
    progress : called with (what, done, total).
    checkpoint : Checkpoint
        A folder from which a run that was stopped goes on, to the same result.

    Raises
    ------
    ObservationError
        What would be ignored: contacts without smoothing or with a lag, noise without a lag, a height where the body
        is not sized, a trial or shape_frames without keypoints of two cameras. A lag of less than a frame or as long
        as the take; a height that cannot be.
    TrackingError
        Nobody can be found, or no frame shows enough of the person.
    TrackingInterrupted
        Ctrl-C after at least one tracked frame.
    """
    of_kind(recording, Recording, "the recording", "Give a Recording: Recording.of_keypoints(rig, keypoints).")
    of_kind(body, Body, "the body", 'Load it: load_body("humanoid").')
    if contacts and not smooth:
        raise ObservationError("contacts=True needs smoothing over the whole take", remedy="Leave out smooth=False.")
    if lag is not None and (contacts or not smooth):
        what = "contacts=True" if contacts else "smooth=False"
        raise ObservationError(f"lag = {lag:g} s and {what} exclude each other", remedy="Leave out one of them.")
    if noise is not None and lag is None:
        raise ObservationError("noise needs a lag", remedy="Leave out noise: it is estimated from the whole take.")
    if lag is not None and lag_frames(lag, recording.rate) >= len(recording):
        problem = f"lag = {lag:g} s is longer than the take of {len(recording)} frames at {recording.rate:g} Hz"
        raise ObservationError(problem, remedy="Leave out the lag, to smooth over the whole take.")
    if height is not None and not 0.3 < height < 3.0:
        raise ObservationError(f"height is {height:g} m", remedy="Give a height in metres, from 0.3 to 3.")
    settings = settings or TrackSettings()
    packages = {type(sensor).__module__.partition(".")[0] for sensor in recording.sensors}
    if checkpoint is not None and packages - checkpoint.packages:
        problem = "a checkpoint cannot store the state of custom sensors that are no kinds of the take"
        raise ObservationError(problem, remedy="Leave out checkpoint.")
    known = Subject.as_is(body) if subject is None and not size else subject
    person = fitted_to_person(
        recording, body, settings, subject=known, trial=trial, height=height, frames=shape_frames, progress=progress
    )
    how = Estimation(smooth and lag is None, contacts, None, recording.level, lag, noise)
    return motion_of_person(person, settings, how, progress=progress, checkpoint=checkpoint)


def motion_of_person(
    person: SizedPerson, settings: TrackSettings, how: Estimation, *, each: bool = False,
    progress: Progress | None = None, checkpoint: Checkpoint | None = None,
) -> Motion:  # fmt: skip
    """Motion of a sized person: all steps are tracked, then smoothed if `how` says so.

    Parameters
    ----------
    each : bool
        Labelled markers alone, not smoothed: fit each frame on its own, from its neighbour's pose in either direction
        of time. Otherwise a frame that is not smoothed knows of no later one.
    progress, checkpoint : as of `track`

    Raises
    ------
    TrackingError, TrackingInterrupted
        As `track`.
    """
    recording, fitted = person.recording, None
    if (how.smooth or each) and how.lag is None and person.start is None and not person.poses:
        fitted = fit_marker_steps(recording, person.subject.body, settings, judge=not how.smooth, progress=progress)
    tracked = fitted or run(
        recording, person.subject.body, settings, start=person.start, values=person.values,
        view_bias=person.subject.view_bias, poses=person.poses, progress=progress, checkpoint=checkpoint,
    )  # fmt: skip
    tracker = tracked.tracker
    others = {} if recording.followed is None else recording.followed.as_record()
    more = {**person.provenance, **others, "frames": {"dropped": tracker.dropped, "late": tracker.late}}
    if (family := person.subject.body.family) is not None:
        more["body shape"] = {name: round(value, 3) for name, value in family.shape.items()}
    eye = None if recording.alone is None else recording.alone.centre_world
    lag = how.lag if tracked.complete else None
    how = replace(how, smooth=how.smooth and tracked.complete, eye=eye, lag=lag)
    motion = motion_of(
        tracked, person.subject, how, up=recording.up, name=recording.name, more=more, found=person.joint
    )
    if not tracked.complete:
        raise TrackingInterrupted(motion, len(recording))
    return motion
