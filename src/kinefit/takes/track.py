"""From a take file to a motion."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike

import numpy as np

from kinefit._arguments import checked
from kinefit.bodies import Body, load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import KinefitError, TakeError, command, located
from kinefit.exporters.gait.plates import standing_mass
from kinefit.exporters.report.feet import foot_findings
from kinefit.fitting.smoothing.online.fixed_lag import KnownNoise
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking import take_recording
from kinefit.fitting.tracking.cameras import as_found
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, TrackingInterrupted
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.fitting.tracking.video import Progress, track
from kinefit.markers.take.takes import with_names
from kinefit.readers.calibration.read import found_notes
from kinefit.readers.motion import read_motion
from kinefit.readers.take.checks import check_enough
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.kinds import kinds_of, naming_plugins
from kinefit.readers.take.load import Observations, load_observations
from kinefit.rigs.diagnostics.images import load_uncovered
from kinefit.rigs.diagnostics.quick import input_findings, with_cause, with_findings
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences.closures import BAND, with_bands
from kinefit.takes.in_view import InView, people_in_view
from kinefit.takes.missing import prepared

_DEFAULT_BODY = "humanoid"  # body of a take that names none


@checked
def track_take(
    take: Take | str | PathLike[str], *, smooth: bool = True, contacts: bool = False,
    lag: float | None = None, noise: KnownNoise | None = None, settings: TrackSettings | None = None,
    progress: Progress | None = None, checkpoint: Checkpoint | None = None, view: InView | None = None,
) -> tuple[Motion, Observations]:
    """Track the person of a take file in all that its sensors saw, as `kinefit track` does; arguments as of `track`.

    What the take lacks is found first and kept next to it (`prepared`): keypoints, cameras, clocks. Returns the motion
    and what the sensors saw (for overlays), with cameras where the fit found them. `view`: who is in view, where
    `people_in_view` has looked before.
    `provenance["findings"]` has the faults of images, cameras and keypoints that a quick check finds, always.

    Raises
    ------
    TakeError
        Nothing in the take shows where the person is, or its subject's trial has another body.
    KinefitError
        What reading and tracking raise.
    """
    take = take if isinstance(take, Take) else read_take(take)
    check_enough(take)
    take = prepared(take, progress)
    view = view or people_in_view(take)
    seen = with_names(take, view.seen if view else load_uncovered(take), progress=progress)
    body = load_body(take.body) if take.start is None else read_motion(take.start).body
    sensors = (seen.keypoints, take.markers, take.depth, take.stereo, take.skin)
    alone = take.start or take.pose or any(sensors) or any(kind.finds_pose for kind in kinds_of(take))
    if take.sensors and not alone:
        table = next(iter(take.sensors))
        raise TakeError(
            "it alone does not determine the first pose", file=take.path, place=f"[[{table}]]",
            remedy='Add [start], or [[keypoints]] with frames = [0, 1], or start = "motion.npz" to [take].',
        )  # fmt: skip
    if not alone:
        raise _without_keypoints(take, " and no other sensor")
    named = body if take.start is None or take.body == _DEFAULT_BODY else load_body(take.body)
    if named.tree.segments != body.tree.segments:
        raise TakeError(
            f"body is {take.body}, but the motion of start has the body {body.name}",
            file=take.path, place="[take] start", remedy="Leave out body, or start from a motion of this body.",
        )  # fmt: skip
    body = with_bands_of(take, body)
    with naming_plugins(((one.recording.sensor, one.kind) for one in seen.sensors), take.path):
        recording, body = take_recording.recording_of(take, seen, body, view.people if view else None)
        settings = settings_of(take, settings)
        if view is not None:
            recording = view.recording(recording, body, take.person, settings)
        if take.pose is not None:
            recording = take_recording.with_fitted_start(recording, body, settings, low_pass=take.pose.low_pass)
        labels = take_recording.label_findings_of(take, seen, body, refuse=True)
        followed = recording.followed.keypoints if recording.followed else ()
        findings = (*labels, *input_findings(take, seen, followed, body))
        try:
            motion = track(
                recording, body, trial=trial_of(take), height=take.height, smooth=smooth, contacts=contacts,
                size=take.size or (take.start is None and take.size is None), lag=lag, noise=noise, settings=settings,
                progress=progress, checkpoint=checkpoint,
            )  # fmt: skip
        except TrackingInterrupted as stopped:
            motion = with_findings(stopped.motion.with_mass(take.mass), findings, seen, take.height)
            raise TrackingInterrupted(motion, stopped.total) from None
        except KinefitError as error:
            raise with_cause(error, findings) from error
    motion = replace(motion.with_mass(_mass_of(take, seen, motion.body)), plates=seen.plates, events=seen.events)
    findings = (*findings, *take_recording.pose_contradictions(motion, seen), *foot_findings(motion))
    motion = with_findings(motion, findings, seen, take.height)
    motion = take_recording.on_floor(motion, recording, view.floors if view else [])
    if seen.rig is not None:
        seen = replace(seen, rig=take_recording.rig_on_floor(as_found(seen.rig, motion.provenance), motion.provenance))
    return motion, seen


def _mass_of(take: Take, seen: Observations, body: Body) -> float | None:
    """[kg] that the take states, or of a person who stands on the plates of a static trial, or of the trial itself."""
    if take.mass is not None:
        return take.mass
    return standing_mass([*(m.plates for m in seen.static_markers if m is not None), seen.plates], body)


def settings_of(take: Take, settings: TrackSettings | None = None) -> TrackSettings:
    """With what the take states of its calibration."""
    settings, entry = settings or TrackSettings(), take.calibration
    if entry is None or entry.position_sigma is None or entry.rotation_sigma is None:
        return settings
    std = entry.position_sigma, float(np.radians(entry.rotation_sigma))
    return replace(settings, camera_std=std if min(std) > 0.0 else None, own_world=bool(found_notes(entry)))


def load_keypoints(take: Take, *, exteriors: bool = True) -> Observations:
    """What the sensors of a take saw, keypoints of cameras among it; `exteriors` as in `load_observations`.

    Raises TakeError for a take without keypoints.
    """
    observations = load_observations(take, exteriors=exteriors)
    if not observations.keypoints or observations.rig is None:
        raise _without_keypoints(take)
    return observations


def _without_keypoints(take: Take, more: str = "") -> TakeError:
    remedy = f"Add keypoints of two or more cameras; {command('detect', take.path)} detects them in videos."
    return TakeError(f"the take has no [[keypoints]]{more}", file=take.path, remedy=remedy)


def with_bands_of(take: Take, body: Body) -> Body:
    """The body with the elastic bands that a take names; a body that has bands (of `start`) keeps them."""
    if take.bands is None or any(closure.name.startswith(BAND) for closure in body.closures):
        return body
    with located(take.path, "[take] bands"):
        return with_bands(body, take.bands)


def trial_of(take: Take, *, frames: int = 50) -> Subject | None:
    """The person as another trial shows it, where a take names one (`subject`); TakeError for one of another body."""
    if take.subject is None:
        return None
    trial = prepared(read_take(take.subject))
    if trial.body != take.body:
        raise TakeError(
            f"the take of subject has the body {trial.body}, this take {take.body}", file=take.path,
            place="[take] subject", remedy="Write the same body into both takes.",
        )
    seen, body = load_keypoints(trial), with_bands_of(take, load_body(take.body))
    assert seen.rig is not None
    sigma, cameras = [entry.sigma for entry in trial.keypoints], settings_of(trial).camera_errors
    of_person = Recording.of_keypoints(seen.rig, seen.keypoints, sigma=sigma, person=trial.person)
    channels = channels_of(of_person, body, TrackSettings())
    return fit_subject(body, channels, frames=frames, height=trial.height or take.height, cameras=cameras)
