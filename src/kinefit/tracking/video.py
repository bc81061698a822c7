"""From a recording of any sensors to a motion: the main job."""

from __future__ import annotations

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.motion import Motion
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.keypoints import Progress, Subject
from kinefit.tracking.interrupted import TrackingInterrupted
from kinefit.tracking.motions import TrackedFrames, motion_of
from kinefit.tracking.recording import Recording
from kinefit.tracking.run import run
from kinefit.tracking.sizing import fitted_to_person


def track(
    recording: Recording, body: Body, *, subject: Subject | None = None, trial: Subject | None = None,
    height: float | None = None, size: bool = True, settings: TrackSettings | None = None, smooth: bool = True,
    contacts: bool = False, shape_frames: int = 25, progress: Progress | None = None,
) -> Motion:  # fmt: skip
    """Motion of one person from whatever sensors saw, with no pose given.

    The body is fitted to the person, every frame is fitted to all that was measured then, with outliers and exchanged
    sides set right, lost limbs sought; in the end all frames are fitted together with a motion prior whose process
    noise the take itself tells.

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
    shape_frames : int, how many frames bone lengths are found from.
    progress : called with (what, done, total).

    Raises
    ------
    ObservationError
        Contacts without smoothing, which would be ignored; a height that cannot be.
    TrackingError
        Nobody can be found, or no frame shows enough of the person.
    TrackingInterrupted
        Ctrl-C after at least one tracked frame.
    """
    if contacts and not smooth:
        remedy = "Leave smooth as it is: contacts need the whole take."
        raise ObservationError("contacts without smoothing", remedy=remedy)
    if height is not None and not 0.3 < height < 3.0:
        raise ObservationError(f"a height of {height:g} m", remedy="Give the person's height in metres.")
    settings = settings or TrackSettings()
    person = fitted_to_person(
        recording, body, settings, subject=subject, trial=trial, height=height, size=size, frames=shape_frames,
        progress=progress,
    )  # fmt: skip
    tracked = run(
        person.recording, person.subject.body, person.channels, settings, start=person.start, values=person.values,
        progress=progress,
    )  # fmt: skip
    steps, tracker = tracked.steps, tracked.tracker
    frames = TrackedFrames(
        person.channels.part(steps), tracked.results, tracked.measurements, tracked.leftovers,
        recording.times[steps], recording.rate, tracker.scene_of, tracker.apart,
    )  # fmt: skip
    told = {**person.told, "frames": {"dropped": tracker.dropped, "late": tracker.late}}
    motion = motion_of(
        frames, person.subject, settings, smooth=smooth and tracked.complete, contacts=contacts, up=recording.up,
        name=recording.name, told=told,
    )  # fmt: skip
    if not tracked.complete:
        raise TrackingInterrupted(motion, len(recording))
    return motion
