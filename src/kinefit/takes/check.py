"""`check_take`: find the faults of a recording, with their evidence and remedies."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from os import PathLike

from kinefit._arguments import checked
from kinefit.bodies import load_body
from kinefit.errors import KinefitError, command
from kinefit.exporters.report.feet import foot_findings
from kinefit.findings import Finding
from kinefit.fitting.markers.subject import fit_marker_subject
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.sizing import SizedPerson, sized_by_depth
from kinefit.fitting.tracking.take_recording import label_findings_of, pose_findings_of, recording_of, sensors_of
from kinefit.fitting.tracking.video import fit_markers
from kinefit.readers.take.cameras import is_alone
from kinefit.readers.take.file import Take, read_take
from kinefit.rigs.diagnostics.checks import CHECKS, Check, Checked, Progress, run
from kinefit.rigs.diagnostics.images import finding_of
from kinefit.rigs.diagnostics.person import UNCHECKED, depth_findings
from kinefit.rigs.diagnostics.quick import inverted_findings
from kinefit.rigs.sensors import fit_sensors
from kinefit.sensors.alignment import sensor_findings
from kinefit.takes.missing import prepared
from kinefit.takes.preparing.detecting import Tell
from kinefit.takes.preparing.take import warn


@checked
def check_take(
    take: Take | str | PathLike[str], *, progress: Progress = lambda *_: None, tell: Tell = warn
) -> Checked:
    """Find all faults of a take, as `kinefit check` does.

    What the take lacks is found first and kept next to it (`prepared`): keypoints, cameras, clocks. Files that cannot
    be read, and images that do not fit their calibration, become findings; the check goes on without them.

    Parameters
    ----------
    progress : called with an action, the steps done and their number
    tell : called with what was found first, in sentences; default: a warning

    Raises
    ------
    KinefitError
        The take file itself cannot be read; what finding cameras raises.
    """
    take = take if isinstance(take, Take) else read_take(take)
    if is_alone(take):
        text = f"Camera {take.cameras[0].name} is alone and not calibrated: there is nothing to check it against."
        return Checked(take.name, (Finding("note", "load", text, remedy=f"Run: {command('track', take.path)}"),), take)
    take = prepared(take, progress, tell, lenient=True)
    known = Checked(take.name, take=take, body=take.body, up=take.up, height=take.height, progress=progress)
    return run(known, ALL_CHECKS)


def _labels(c: Checked) -> Iterable[Finding]:
    """Labels of markers and sides of poses; markers without names, by the take's models, are not looked at."""
    named = c.take.markers and not any(entry.model for entry in c.take.markers)
    return (label_findings_of if named else pose_findings_of)(c.take, c.observations, load_body(c.take.body))


def _depth_alone(c: Checked) -> list[Finding]:
    """Depth cameras alone: an upside-down image of the person."""
    if not c.observations.depth or c.take.cameras or c.take.markers:
        return []
    found = [Finding("note", "load", UNCHECKED, remedy="Add videos of two cameras, whose keypoints show the person.")]
    try:
        recording, body = recording_of(c.take, c.observations, load_body(c.take.body))
        person = sized_by_depth(SizedPerson(recording, Subject.as_is(body)))
    except KinefitError as error:
        return [*found, finding_of(error)]
    return [*found, *inverted_findings(person.provenance, c.take.up)]


def _sensors(c: Checked) -> list[Finding]:
    """Depth cameras and marker systems against the videos, if these have no fault."""
    if not (c.take.depth or c.take.markers):
        return []
    if c.faults:
        text = "The fit of other sensors to the videos is not checked: correct the faults first."
        return [Finding("note", "sensor", text)]
    try:
        c.sensors = fit_sensors(c.take, c.observations, progress=c.progress)
    except KinefitError as error:
        text = f"The fit of other sensors to the videos cannot be determined: {error.problem}."
        return [Finding("note", "sensor", text, remedy=error.remedy or "")]
    return sensor_findings(c.sensors, c.take)


def _feet(c: Checked) -> list[Finding]:
    """Force plates, and the events of marker files, against the feet of the first labelled markers."""
    seen = c.observations
    if not (seen.plates or seen.events) or not c.take.markers or c.take.markers[0].model or c.faults:
        return []
    entry, markers, trial = c.take.markers[0], seen.markers[0].trimmed(), seen.static_markers[0]
    try:
        body, trials = load_body(c.take.body), [trial, markers] if trial else [markers]
        subject = fit_marker_subject(body, trials, entry.set, height=c.take.height)
        motion = fit_markers(subject, markers, up=c.take.up, smooth=False)
    except KinefitError as error:
        return [finding_of(error)]
    times = motion.times + entry.time_offset
    found = foot_findings(replace(motion, times=times, plates=seen.plates, events=seen.events))
    return [*found] or [Finding("good", "plates", "Force plates and events of the files fit the feet.")]


def _kinds(c: Checked) -> list[Finding]:
    """Sensors of kinds that stand apart: whether they can be made for the body, and what their own check finds."""
    out, body = list[Finding](), load_body(c.take.body)
    try:
        sensors_of(c.take, c.observations, body)
        for of in c.observations.sensors:
            if of.kind.check is not None:
                valid = lambda found: all(isinstance(one, Finding) for one in found)
                out += of.kind.call("check", of.entry, of.recording, body, valid=valid, what="findings")
    except KinefitError as error:
        out.append(finding_of(error))
    return out


ALL_CHECKS = (
    *CHECKS,
    Check(
        "labels of markers", _labels, ("take", "observations"), 2.0,
        "Exchanged sides and a mirrored world look the same; markers placed elsewhere look like exchanged labels.",
    ),
    Check(
        "unit and lens of depth cameras", lambda c: depth_findings(c.take, c.observations.depth),
        ("take", "observations"), 1.0,
        "Wrong focal lengths, people side by side, an image cropped on one side and a round room look the same.",
    ),
    Check(
        "depth cameras alone", _depth_alone, ("take", "observations"), 20.0,
        "A person who stands on the hands looks the same.",
    ),
    Check(
        "kinds of sensors", _kinds, ("take", "observations"), 1.0,
        "A wrong file, a clock that is off and another unit of the sensor look the same.",
    ),
    Check(
        "force plates and events", _feet, ("take", "observations"), 10.0,
        "Markers of the feet that moved on the skin look the same.",
    ),
    Check(
        "other sensors", _sensors, ("take", "observations", "keypoints"), 60.0,
        "A clock that is off looks like a shift of who walks, clothes like a shift of the surface.",
    ),
)  # fmt: skip
"""All checks of `kinefit check`, in the order in which they run."""
