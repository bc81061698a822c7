"""A take read as far as it can be: what cannot be read is left out or guessed, each with a finding."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from kinefit.errors import KinefitError, command
from kinefit.findings import Edit, Finding
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.take.cameras import calibrated_size
from kinefit.readers.take.checks import ONE_CAMERA
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.rigs.diagnostics.images import finding_of

_MAX_ATTEMPTS = 12  # to load; each works around one error


def calibrated(take: Take) -> tuple[Take, Rig | None, list[Finding]]:
    """The take without cameras that its calibration lacks, and the calibration's rig; None if that cannot be read."""
    stated = take.calibration
    if stated is None and not take.depth and (take.cameras or not (take.markers or take.sensors)):
        remedy = "Add [[camera]] and [calibration]."
        return take, None, [Finding("fault", "load", "The take names no cameras.", remedy=remedy)]
    try:
        size = partial(calibrated_size, take)
        rig = Rig(()) if stated is None else read_calibration(stated.file, unit=stated.unit, image_size=size)
    except KinefitError as error:
        return take, None, [finding_of(error)]
    findings, known = [], [entry.name for entry in take.cameras if entry.name in rig]
    for name in (entry.name for entry in take.cameras if entry.name not in rig):
        text = f"{name} is not in the calibration, which has {', '.join(rig.names)}; it is not used."
        remedy = "Correct its name in the take, or calibrate it too."
        findings.append(Finding("fault", "load", text, (name,), remedy=remedy))
    return (_only(take, known) if findings else take), rig, findings


def _only(take: Take, names: Sequence[str]) -> Take:
    return replace(
        take, cameras=tuple(c for c in take.cameras if c.name in names),
        keypoints=tuple(k for k in take.keypoints if k.camera in names),
    )  # fmt: skip


def framed_keypoints(take: Take) -> tuple[Take, list[Finding]]:
    """The take with `frame` for keypoints without it: the video's, on which detectors run."""
    altered = {e.name for e in take.cameras if e.image != "as calibrated" or e.rotation != 0}
    out, findings = [], []
    for source in take.keypoints:
        camera = source.camera
        if source.frame is None and camera in altered and source.format != "detect":
            text = f"The take does not state if keypoints of {camera} are in the image of video or calibration."
            remedy = 'Write frame = "video" (assumed here) or frame = "calibration" into its [[keypoints]].'
            sure, edit = "A guess: detectors run on the video.", Edit("keypoints", "frame", '"video"', camera)
            findings.append(Finding("doubt", "frame", text, (camera,), sure, remedy, (edit,)))
            source = msgspec.structs.replace(source, frame="video")
        out.append(source)
    return replace(take, keypoints=tuple(out)), findings


def observations_of(take: Take) -> tuple[Take, Observations | None, list[Finding]]:
    """What the sensors of a take saw, and the take that could be read; None with fewer than two cameras left."""
    findings: list[Finding] = []
    for _ in range(_MAX_ATTEMPTS):
        try:
            return take, load_observations(take), findings
        except KinefitError as error:
            findings.append(finding_of(error))
            reduced = _without(take, error, findings[-1].edits)
            if reduced is None:
                break
            take = reduced
    return take, None, findings


def _without(take: Take, error: KinefitError, edits: Sequence[Edit]) -> Take | None:
    """The take with a workaround for an error: other frames, or without the faulty file; None if there is none."""
    if edits and error.file == take.path:
        first, stop = json.loads(edits[0].value or "")
        return replace(take, frames=(first, stop)) if take.frames != (first, stop) else None
    place = error.place or ""
    for source in take.keypoints:
        files = [source.file, *(entry.video for entry in take.cameras if entry.name == source.camera)]
        named = source.camera in place.replace(",", " ").split() and "keypoints" in place
        if named or any(_within(error.file, file) for file in files if file):
            cameras = [entry.camera for entry in take.keypoints if entry is not source]
            return _only(take, cameras) if len(set(cameras)) >= 2 else None
    return None


def _within(file: object, place: Path) -> bool:
    return isinstance(file, str | Path) and (Path(file) == place or place in Path(file).parents)


def too_few(take: Take, seen: Observations, cameras: int) -> list[Finding]:
    """Why the keypoints of so many cameras cannot be checked; nothing of depth alone."""
    if seen.depth and not (take.cameras or take.markers):
        return []
    if take.markers and not take.cameras:
        return [Finding("note", "load", "Markers alone: labels, plates and events are checked, and nothing else.")]
    if take.sensors and not take.keypoints and not cameras:
        return [Finding("note", "load", "No keypoints: each sensor is checked by itself, and nothing else.")]
    text = f"Keypoints of {cameras} camera(s): a check needs those of two or more."
    alone = len(take.cameras) == 1
    remedy = f"{ONE_CAMERA[0].upper()}{ONE_CAMERA[1:]}." if alone else f"Run: {command('detect', take.path)}"
    return [Finding("fault", "load", text, remedy=remedy)]
