"""`check_take`: what is wrong with a recording, in plain words, how sure that is, and what would mend it."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike

from kinefit._arguments import checked
from kinefit.calibration.check.loading import load_leniently
from kinefit.calibration.check.sensor_verdicts import sensor_findings
from kinefit.calibration.check.sensors import fit_sensors
from kinefit.diagnostics.keypoints import Check, Progress, check_keypoints
from kinefit.diagnostics.scene import lens_findings
from kinefit.diagnostics.sensor_fit import SensorAlignment
from kinefit.errors import KinefitError, command
from kinefit.findings import Finding, ranked
from kinefit.multiview.followed import PersonKeypoints, follow
from kinefit.readers.take.checks import ONE_CAMERA
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.one_camera import is_alone
from kinefit.readers.take.pictures import TakePictures

_SHOWS_MOST = "moving"  # of several people: who stands still shows cameras little of the volume, and clocks nothing


@checked
def check_take(take: Take | str | PathLike[str], *, progress: Progress | None = None) -> Check:
    """Look for everything that is wrong with a take.

    Files that cannot be read, and pictures that do not fit their calibration, become findings; the rest is checked
    without them.

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
    if seen is None or seen.rig is None or len({k.camera for k in seen.keypoints}) < 2:
        missing = list(loaded.findings)
        if seen is not None:
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
        one = follow(rig, seen.keypoints, take.person or _SHOWS_MOST, pictures=pictures)
    seen = replace(seen, keypoints=one.keypoints)
    begun = Check(take.name, (*loaded.findings, *_others(one, take.person is not None)), loaded.take, seen)
    check = check_keypoints(
        rig.select(tuple(n for n in rig.names if n in named)), seen.keypoints, body=take.body, up=take.up,
        height=take.height, begun=begun, progress=progress,
    )  # fmt: skip
    return _with_sensors(check, progress)


def _others(one: PersonKeypoints, asked: bool) -> list[Finding]:
    """Who else is in view."""
    if len(one.people) < 2:
        return []
    why = "" if asked else ", who moves most and so tells most of the cameras"
    text = f"{len(one.people)} people are in view; the check is by person {one.number}{why}."
    return [Finding("note", "people", text, remedy="Another: write person = 2 to [take], or whichever it is.")]


def _with_sensors(check: Check, progress: Progress | None) -> Check:
    """The check with how depth cameras and marker systems lie against the videos, where these have no fault."""
    take, seen = check.take, check.observations
    if take is None or seen is None or not (take.depth or take.markers):
        return check
    fits: tuple[SensorAlignment, ...] = ()
    if check.faults:
        text = "Whether other sensors fit the videos was not looked at: first the faults must be fixed."
        found = [Finding("note", "sensor", text)]
    else:
        try:
            fits = fit_sensors(take, seen, progress=progress)
            found = sensor_findings(fits, take)
        except KinefitError as error:
            text = f"Whether other sensors fit the videos cannot be told: {error.problem}."
            found = [Finding("note", "sensor", text, remedy=error.remedy or "")]
    return replace(check, findings=ranked([*check.findings, *found]), sensors=fits)
