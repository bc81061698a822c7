"""From a recording of any sensors to a motion: the main job.

Labelled markers of one file to a motion: `track` with one marker sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body
from kinefit.bodies.marker_sets import find_placement
from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError
from kinefit.fitting.markers.subject import MarkerSubject, columns
from kinefit.fitting.smoothing.online.fixed_lag import KnownNoise, lag_frames
from kinefit.fitting.subject.subject import Progress, Subject
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, TrackingInterrupted
from kinefit.fitting.tracking.motions import Estimation, axis_of, motion_of
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.run import fit_marker_steps, run
from kinefit.fitting.tracking.sizing import SizedPerson, fitted_to_person
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import Loss
from kinefit.observations import Markers, NamedMarkers
from kinefit.sensors.base import of_kind
from kinefit.sensors.settings import MARKER_LOSS, TrackSettings


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
        replace(recording, start=person.start, poses=person.poses), person.subject.body, settings,
        values=person.values, view_bias=person.subject.view_bias, progress=progress, checkpoint=checkpoint,
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


_SENSOR = "markers"


@checked
def fit_markers(
    body: Body | MarkerSubject,
    markers: Markers,
    marker_set: str | PathLike[str] | None = None,
    *,
    sigma: float | NDArray | Sequence[float] | None = None,
    loss: Loss = MARKER_LOSS,
    limits: bool = True,
    up: str | None = None,
    smooth: bool = True,
    progress: Progress | None = None,
) -> Motion:
    """Motion of a body of the subject's size from labelled markers, without an initial pose: `track` of them alone.

    Parameters
    ----------
    body : MarkerSubject or Body
        From `fit_marker_subject`, with set, sigma and the uncertainty of lengths and marker offsets. A body of the
        subject's size with its marker offsets counts as exact: standard deviations are then too small.
    markers : Markers
        (F, N, 3) [m]. Labels outside of the set are excluded; prefix ("Anna:LASI"), case and punctuation are ignored.
    marker_set : str
        Default: the subject's; of a body the set that shares most labels, the body's own sets first.
    sigma : scalar or (K,) [m], standard deviation of each marker of the set along each axis
        Default: the subject's; of a body 5 mm.
    loss : Loss of a marker, robust to wrong labels and ghosts
    limits : whether joint limits hold
    up : vertical axis of the world; default: the file's, or else the axis along which the body stands
    smooth : whether all frames are fitted together with a motion prior; otherwise each on its own
    progress : called with (what, done, total)

    Raises
    ------
    ObservationError
        The body knows fewer than four of the labels.
    TrackingError
        No frame shows enough markers to start from.
    """
    known = body if isinstance(body, MarkerSubject) else None
    body = body if isinstance(body, Body) else body.body
    if known is not None and marker_set in (None, known.marker_set):
        marker_set, sigma = known.marker_set, known.sigma if sigma is None else sigma
    placement = find_placement(body, markers.names, marker_set)
    points, stated = placement.points, np.asarray(TrackSettings().marker if sigma is None else sigma, float)
    if stated.ndim and marker_set is not None and len(stated) != len(points):
        labels = body.marker_sets.get(str(marker_set), points)
        stated = stated[[labels.index(n) for n in points.names]]
    each = dict(zip((f"{_SENSOR} {name}" for name in points.names), np.broadcast_to(stated, len(points)).tolist()))
    worn = NamedMarkers(
        _SENSOR, replace(markers, names=points.names, positions=columns(markers, points.names), residual=None),
        placement.name,
    )  # fmt: skip
    fitted = replace(body, marker_sets={placement.name: points, **body.marker_sets})
    fitted = fitted if limits else fitted.without_limits()
    recording = Recording(
        markers.times, markers.rate, Rig(()), steps=lambda i: [worn.at(float(markers.times[i]))], sigma=each,
        markers=(worn,), up=up or markers.up or "z", name=Path(markers.source).stem or "markers",
    )  # fmt: skip
    person = SizedPerson(recording, Subject.as_is(fitted))
    if known is not None:
        person = person.with_markers(known, fitted)
    motion = motion_of_person(
        person, TrackSettings(marker_loss=loss), Estimation(smooth=smooth), each=not smooth, progress=progress
    )
    up = up or markers.up or axis_of(motion.Ts_world_root[:, :3, 1].mean(axis=0))
    return replace(motion, body=body, up=up, plates=markers.plates, events=markers.events)
