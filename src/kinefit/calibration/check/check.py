"""`check_take`: find the faults of a recording, with their evidence and remedies."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path

import msgspec

from kinefit._arguments import checked
from kinefit.bodies import load_body
from kinefit.calibration.check.sensor_verdicts import sensor_findings
from kinefit.calibration.check.sensors import fit_sensors
from kinefit.diagnostics.images import finding_of, fit_image, noise_findings, without_covered
from kinefit.diagnostics.keypoints import Check, Progress, check_keypoints
from kinefit.diagnostics.quick import inverted_findings
from kinefit.diagnostics.scene import lens_findings
from kinefit.diagnostics.sensor_fit import SensorAlignment
from kinefit.errors import KinefitError, command
from kinefit.findings import Finding, ranked
from kinefit.geometry.camera import Rig
from kinefit.multiview.followed import PersonKeypoints, follow
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.take.cameras import calibrated_size, is_alone
from kinefit.readers.take.checks import ONE_CAMERA
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.take.pictures import TakePictures
from kinefit.subject.subject import Subject
from kinefit.tracking.sizing import SizedPerson, sized_by_depth
from kinefit.tracking.takes.take_recording import label_findings_of, recording_of

_DEFAULT_PERSON = "moving"  # of several people: a standing one covers little of the volume, and no clock offsets


@checked
def check_take(take: Take | str | PathLike[str], *, progress: Progress | None = None) -> Check:
    """Find all faults of a take.

    Files that cannot be read, and images that do not fit their calibration, become findings; the check goes on without
    them.

    Raises
    ------
    KinefitError
        The take file itself cannot be read.
    """
    take = take if isinstance(take, Take) else read_take(take)
    if is_alone(take):
        text = f"Camera {take.cameras[0].name} is alone and not calibrated: there is nothing to check it against."
        note = Finding("note", "load", text, remedy=f"Run: {command('track', take.path)}")
        return Check(take.name, (note,), take, None)
    loaded = load_leniently(take)
    seen = loaded.observations
    if seen is not None:
        seen, covered = without_covered(loaded.take, seen)
        noted = (Finding("note", "markers", f"{text}.") for m in seen.markers for text in m.notes)
        found = (*loaded.findings, *covered, *noise_findings(loaded.take, seen.depth), *noted)
        loaded = replace(loaded, observations=seen, findings=found)
    if seen is None or seen.rig is None or len({k.camera for k in seen.keypoints}) < 2:
        missing = [*loaded.findings, *_of_labels(loaded.take, seen)]
        if seen is not None and seen.depth and not (take.cameras or take.markers):
            missing += _of_depth_alone(loaded.take, seen)
        elif seen is not None and take.markers and not take.cameras:
            missing.append(Finding("note", "load", "Markers alone: their labels are checked, and nothing else."))
        elif seen is not None:
            text = (
                f"Keypoints of {len({k.camera for k in seen.keypoints})} camera(s): a check needs those of two or more."
            )
            alone = len(take.cameras) == 1
            remedy = f"{ONE_CAMERA[0].upper()}{ONE_CAMERA[1:]}." if alone else f"Run: {command('detect', take.path)}"
            missing.append(Finding("fault", "load", text, remedy=remedy))
        if seen is not None and seen.rig is not None:
            missing += lens_findings(seen.rig)
        return Check(take.name, ranked(missing), loaded.take, seen)
    rig, named = seen.rig, {entry.camera for entry in loaded.take.keypoints}
    with TakePictures(loaded.take, seen) as pictures:
        person = follow(rig, seen.keypoints, take.person or _DEFAULT_PERSON, images=pictures)
    seen = replace(seen, keypoints=person.keypoints)
    known = (*loaded.findings, *_of_labels(loaded.take, seen))
    begun = Check(take.name, (*known, *_others(person, take.person is not None)), loaded.take, seen)
    check = check_keypoints(
        rig.select(tuple(n for n in rig.names if n in named)), seen.keypoints, body=take.body, up=take.up,
        height=take.height, begun=begun, progress=progress,
    )  # fmt: skip
    return _with_sensors(check, progress)


def _others(person: PersonKeypoints, asked: bool) -> list[Finding]:
    """A note on other people in view."""
    if len(person.people) < 2:
        return []
    why = "" if asked else ", who moves most and so shows the cameras' errors best"
    text = f"{len(person.people)} people are in view; the check is by person {person.number}{why}."
    return [Finding("note", "people", text, remedy="For another person, write person = 2 (or its number) into [take].")]


def _of_labels(take: Take, seen: Observations | None) -> tuple[Finding, ...]:
    """Findings of the labels of the take's markers; those without names, by its models, are not looked at."""
    if seen is None or not take.markers or any(entry.model for entry in take.markers):
        return ()
    return label_findings_of(take, seen, load_body(take.body))


def _of_depth_alone(take: Take, seen: Observations) -> list[Finding]:
    """Findings of a take with depth cameras alone: an upside-down image of the person."""
    text = "Depth alone: the poses of its cameras are not checked."
    found = [Finding("note", "load", text, remedy="Add videos of two cameras, whose keypoints show the person.")]
    try:
        recording, body = recording_of(take, seen, load_body(take.body))
        person = sized_by_depth(SizedPerson(recording, Subject.as_is(body)))
    except KinefitError as error:
        return [*found, finding_of(error)]
    return [*found, *inverted_findings(person.provenance, take.up)]


def _with_sensors(check: Check, progress: Progress | None) -> Check:
    """The check with the alignment of depth cameras and marker systems to the videos, if these have no fault."""
    take, seen = check.take, check.observations
    if take is None or seen is None or not (take.depth or take.markers):
        return check
    fits: tuple[SensorAlignment, ...] = ()
    if check.faults:
        text = "The fit of other sensors to the videos is not checked: correct the faults first."
        found = [Finding("note", "sensor", text)]
    else:
        try:
            fits = fit_sensors(take, seen, progress=progress)
            found = sensor_findings(fits, take)
        except KinefitError as error:
            text = f"The fit of other sensors to the videos cannot be determined: {error.problem}."
            found = [Finding("note", "sensor", text, remedy=error.remedy or "")]
    return replace(check, findings=ranked([*check.findings, *found]), sensors=fits)


_MAX_ATTEMPTS = 12  # to load; each works around one error


@dataclass(frozen=True, eq=False)
class Loaded:
    """The readable part of a take.

    Parameters
    ----------
    take : Take
        With the remedies of the findings, so that it can be read.
    observations : Observations or None
        None with fewer than two cameras left.
    findings : tuple of Finding
    """

    take: Take
    observations: Observations | None
    findings: tuple[Finding, ...]


def load_leniently(take: Take) -> Loaded:
    """Read a take; unreadable parts are skipped or guessed, each with a finding."""
    if take.calibration is None and not take.depth and (take.cameras or not take.markers):
        return Loaded(
            take,
            None,
            (Finding("fault", "load", "The take names no cameras.", remedy="Add [[camera]] and [calibration]."),),
        )
    try:
        stated = take.calibration
        sizes = partial(calibrated_size, take)
        rig = Rig(()) if stated is None else read_calibration(stated.file, unit=stated.unit, image_size=sizes)
    except KinefitError as error:
        return Loaded(take, None, (finding_of(error),))
    findings: list[Finding] = []
    take = _known_cameras(take, rig, findings)
    cameras = []
    for entry in take.cameras:
        fitting, found = fit_image(entry, rig[entry.name].size, take.rate)
        cameras.append(fitting)
        findings += found
    take = replace(take, cameras=tuple(cameras))
    take = _framed_keypoints(take, rig, findings)
    for _ in range(_MAX_ATTEMPTS):
        try:
            return Loaded(take, load_observations(take), tuple(findings))
        except KinefitError as error:
            findings.append(finding_of(error))
            reduced = _without(take, error)
            if reduced is None:
                break
            take = reduced
    return Loaded(take, None, tuple(findings))


def _known_cameras(take: Take, rig: Rig, findings: list[Finding]) -> Take:
    """The take without cameras that the calibration lacks; adds a finding for each."""
    unknown = [entry.name for entry in take.cameras if entry.name not in rig]
    for name in unknown:
        text = f"{name} is not in the calibration, which has {', '.join(rig.names)}; it is not used."
        remedy = "Correct its name in the take, or calibrate it too."
        findings.append(Finding("fault", "load", text, (name,), remedy=remedy))
    return _only(take, [entry.name for entry in take.cameras if entry.name in rig]) if unknown else take


def _only(take: Take, names: list[str]) -> Take:
    return replace(
        take, cameras=tuple(c for c in take.cameras if c.name in names),
        keypoints=tuple(k for k in take.keypoints if k.camera in names),
    )  # fmt: skip


def _framed_keypoints(take: Take, rig: Rig, findings: list[Finding]) -> Take:
    """The take with `frame` for keypoints without it: the video's, on which detectors run."""
    entries = {entry.name: entry for entry in take.cameras}
    out = []
    for source in take.keypoints:
        entry = entries[source.camera]
        differs = entry.image != "as calibrated" or entry.rotation != 0
        if source.frame is None and differs and source.format != "detect":
            text = (
                f"The take does not state if keypoints of {source.camera} are in the image of video or calibration."
            )
            remedy = 'Write frame = "video" (assumed here) or frame = "calibration" into its [[keypoints]].'
            findings.append(Finding("doubt", "frame", text, (source.camera,), remedy=remedy))
            source = msgspec.structs.replace(source, frame="video")
        out.append(source)
    return replace(take, keypoints=tuple(out))


def _without(take: Take, error: KinefitError) -> Take | None:
    """The take with a workaround for an error: other frames, or without the faulty file; None if there is none."""
    frames = re.search(r"frames = \[(\d+), (\d+)\]", error.remedy or "")
    if frames and error.file == take.path:
        cut = int(frames[1]), int(frames[2])
        return replace(take, frames=cut) if take.frames != cut else None
    for source in take.keypoints:
        if any(_within(error.file, file) for file in (source.file, *_of_camera(take, source.camera)) if file) or (
            source.camera in (error.place or "").replace(",", " ").split() and "keypoints" in (error.place or "")
        ):
            cameras = [entry.camera for entry in take.keypoints if entry is not source]
            return _only(take, cameras) if len(set(cameras)) >= 2 else None
    return None


def _of_camera(take: Take, name: str) -> Iterator[Path]:
    for entry in take.cameras:
        if entry.name == name and entry.video:
            yield entry.video


def _within(file: object, place: Path) -> bool:
    return isinstance(file, str | Path) and (Path(file) == place or place in Path(file).parents)
