"""The engine of checks: what is asked of a recording, at which cost, what would look the same, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, load_body
from kinefit.errors import KinefitError
from kinefit.findings import Finding, faults_of, ranked
from kinefit.fitting.multiview import views
from kinefit.fitting.multiview.followed import follow
from kinefit.fitting.multiview.views import KeypointViews, make_views, with_sides_right
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.readers.calibration.read import found_notes
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.take.videos import TakePictures
from kinefit.rigs.diagnostics import cameras, changes, images, lenient, mistakes, person, rig, timing
from kinefit.rigs.diagnostics.rig import CameraCoverage
from kinefit.sensors.alignment import SensorAlignment

Progress = Callable[[str, int, int], None]

QUICK_S = 0.5
"""[s] largest cost of a check that `kinefit track` runs."""

_UNKNOWN: Any = None  # what no check has found out yet
_SAMPLE_FRAMES = 240  # spread over the recording, for properties that are constant over time
_QUICK_FRAMES = 150  # consecutive frames in which a quick check compares clocks
_COURSE_FRAMES = 360  # consecutive frames in which it looks for clocks that change
_QUICK_INTERVALS = 5  # candidates for these, spread over the recording: the one with most motion is used
_MAX_JUMP_PX = 100.0  # in five frames; a larger one is to another person
_STATED_IMAGES = ("scaled", "letterboxed")  # statements of the take that one image of the video can contradict
_DEFAULT_PERSON = "moving"  # of several people: a standing one covers little of the volume, and no clock offsets


@dataclass(frozen=True)
class Check:
    """One question to a recording.

    Parameters
    ----------
    name : of what it is about, for people
    test : from what is known so far to findings. It leaves what is known as it would be with its findings corrected,
        for the checks after it.
    needs : attributes of `Checked` that must be there (true, or not empty)
    cost : [s] of one core for 100 frames of four cameras (of depth cameras: for their images), as measured. Tracking
        runs checks of at most `QUICK_S`.
    alike : what else would look the same, in one sentence; added to faults and doubts
    reads : whether it reads files, which `kinefit track` does by itself
    """

    name: str
    test: Callable[[Checked], Iterable[Finding]]
    needs: tuple[str, ...]
    cost: float = 0.02
    alike: str = ""
    reads: bool = False


@dataclass(eq=False)
class Checked:
    """A recording with what the checks have found and measured.

    Parameters
    ----------
    name : str
        Of the take.
    findings : tuple of Finding, worst first.
    take : Take or None
        As read, with the remedies of the findings applied where entries did not fit.
    observations : Observations or None
    rig, keypoints : of the cameras that saw the person.
    body, up, height : the person's body, vertical axis of the world, and stature [m] as stated or None.
    quick : whether to finish within a second: with the cheap checks, clocks compared in the interval with most motion,
        left and right in a sample of the frames.
    progress : called with an action, the steps done and their number.
    sound : whether nothing was found so far of which all that follows would be a consequence.
    views : KeypointViews or None
        The person's keypoints, with left and right corrected and cameras synchronised; a sample of the frames after a
        quick check.
    moving, stepped : views of consecutive frames, before and after they are synchronised
    sampled, x : views of some frames, and their triangulated points (F, K, 3) [m]
    biases, coverage : one for each camera.
    times : TimeOffsets or None
    frames_late : {camera: int}
        Number of frames by which a camera's views were shifted to synchronise them; empty if none were.
    sensors : alignment of each depth camera and marker system with the videos.
    """

    name: str
    findings: tuple[Finding, ...] = ()
    take: Take = _UNKNOWN
    observations: Observations = _UNKNOWN
    rig: Rig = _UNKNOWN
    keypoints: Sequence[Keypoints] = ()
    body: str | Body = "humanoid"
    up: str = "z"
    height: float | None = None
    quick: bool = False
    progress: Progress = lambda *_: None
    sound: bool = True
    views: KeypointViews = _UNKNOWN
    moving: KeypointViews = _UNKNOWN
    stepped: KeypointViews = _UNKNOWN
    sampled: KeypointViews = _UNKNOWN
    x: NDArray = _UNKNOWN
    biases: tuple[cameras.CameraBias, ...] = ()
    coverage: tuple[CameraCoverage, ...] = ()
    times: timing.TimeOffsets = _UNKNOWN
    frames_late: Mapping[str, int] = _UNKNOWN
    sensors: tuple[SensorAlignment, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        """Findings of the severity "fault"."""
        return faults_of(self.findings)

    def of(self, camera: str) -> tuple[Finding, ...]:
        """Findings about one camera."""
        return tuple(found for found in self.findings if camera in found.cameras)

    @cached_property
    def x_world(self) -> NDArray:
        """(F, K, 3) [m] triangulated keypoints of all views."""
        return views.meet(self.views)[0]

    @property
    def file(self) -> Path:
        """The take file, for remedies."""
        return self.take.path if self.take else Path(f"{self.name}.toml")


def run(checked: Checked, checks: Sequence[Check]) -> Checked:
    """Run checks one after the other, as far as they are cheap enough and what they need is there."""
    some = [check for check in checks if not checked.quick or (check.cost <= QUICK_S and not check.reads)]
    for done, check in enumerate(some):
        checked.progress("checking", done, len(some))
        if all(getattr(checked, need) for need in check.needs):
            checked.findings += tuple(
                replace(f, alike=check.alike) if f.severity in ("fault", "doubt") else f for f in check.test(checked)
            )
    checked.progress("checking", len(some), len(some))
    checked.findings = ranked(checked.findings)
    return checked


def check_keypoints(
    rig: Rig, keypoints: Sequence[Keypoints], *, body: str | Body = "humanoid", up: str = "z",
    height: float | None = None, quick: bool = False, progress: Progress = lambda *_: None,
) -> Checked:  # fmt: skip
    """Run all checks on keypoints and the rig of their cameras.

    Parameters
    ----------
    rig : Rig of the cameras of the keypoints.
    keypoints : records of the same number of frames and the same rate.
    body : the body, or its name or file; its bone lengths give the person's height.
    up : str, vertical axis of the world.
    height : float [m] stature; None if unknown.
    quick, progress : as in `Checked`
    """
    return run(Checked("take", rig=rig, keypoints=keypoints, body=body, up=up, height=height, quick=quick,
                       progress=progress), CHECKS)  # fmt: skip


def _calibration(c: Checked) -> list[Finding]:
    c.take, stated, found = lenient.calibrated(c.take)
    c.sound, c.rig = stated is not None, stated or Rig(())
    return found


def _pictures(c: Checked) -> list[Finding]:
    """Images of the videos against the calibration's; of a quick check those that the take calls altered."""
    calibrated, findings, entries = (c.observations and c.observations.rig) or c.rig, list[Finding](), []
    for entry in c.take.cameras:
        if not c.quick or entry.image in _STATED_IMAGES:
            entry, found = images.fit_image(entry, calibrated[entry.name].size, c.take.rate, frames=1 if c.quick else 5)
            findings += found
        entries.append(entry)
    if not c.quick:
        c.take = replace(c.take, cameras=tuple(entries))
    return findings


def _image_frames(c: Checked) -> list[Finding]:
    c.take, found = lenient.framed_keypoints(c.take)
    return found


def _files(c: Checked) -> list[Finding]:
    c.take, seen, found = lenient.observations_of(c.take)
    c.sound, c.observations = seen is not None, seen or _UNKNOWN
    return found


def _frozen(c: Checked) -> list[Finding]:
    c.observations, found = images.without_frozen(c.observations)
    return found


def _covered(c: Checked) -> list[Finding]:
    c.observations, found = images.without_covered(c.take, c.observations)
    return found


def _notes(c: Checked) -> list[Finding]:
    """What readers have to say of their files."""
    found = found_notes(c.take.calibration)
    return [Finding("note", "files", f"{text}.") for text in c.observations.notes if text not in found]


def _person(c: Checked) -> list[Finding]:
    """Whose keypoints are checked: of several people the one who moves most, if the take names none."""
    seen, showing = c.observations, {k.camera for k in c.observations.keypoints}
    c.rig = seen.rig or Rig(())
    if seen.rig is None or len(showing) < 2:
        return lenient.too_few(c.take, seen, len(showing))
    with TakePictures(c.take, seen) as pictures:
        followed = follow(seen.rig, seen.keypoints, c.take.person or _DEFAULT_PERSON, images=pictures)
    named = {entry.camera for entry in c.take.keypoints}
    c.rig, c.keypoints = seen.rig.select(tuple(n for n in seen.rig.names if n in named)), followed.keypoints
    c.observations = replace(seen, keypoints=followed.keypoints)
    if len(followed.people) < 2:
        return []
    why = "" if c.take.person is not None else ", who moves most and so shows the cameras' errors best"
    text = f"{len(followed.people)} people are in view; the check is by person {followed.number}{why}."
    others = " or ".join(str(k) for k in range(1, len(followed.people) + 1) if k != followed.number)
    return [Finding("note", "people", text, remedy=f"For another person, write person = {others} into [take].")]


def _nobody(c: Checked) -> list[Finding]:
    moving = [_most_motion(k, c.keypoints) for k in c.keypoints] if c.quick else c.keypoints
    try:
        c.moving = views.make_views(c.rig, moving)
        c.views = views.make_views(c.rig, [_thinned(k) for k in c.keypoints]) if c.quick else c.moving
    except KinefitError as error:
        c.sound = False
        text = f"{error.problem[:1].upper()}{error.problem[1:]}."
        return [Finding("fault", "nobody", text, remedy=error.remedy or "")]
    return []


def _other_frame(c: Checked) -> list[Finding]:
    stated = {k.camera: k.frame for k in c.take.keypoints if k.frame is not None}
    found, c.views = cameras.frame_findings(c.views, c.observations.images, stated)
    return found


def _mistakes(c: Checked) -> list[Finding]:
    found = mistakes.mistake_findings(c.views.spread(_SAMPLE_FRAMES), c.file.name)
    c.sound = not found
    return found


def _unseen(c: Checked) -> list[Finding]:
    """Cameras without any detection, which are excluded."""
    seen = dict(zip(c.views.rig.names, np.isfinite(c.views.uv).any(axis=(0, 1, 3)), strict=True))
    c.views, findings = c.views.select([name for name in seen if seen[name]]), []
    c.sound = len(c.views.rig) > 0
    for name in (name for name in seen if not seen[name]):
        highest = max(float(k.confidence.max(initial=0.0)) for k in c.keypoints if k.camera == name)
        few = f" with a confidence above {views.MIN_CONFIDENCE} (highest: {highest:.2g})" if highest > 0.0 else ""
        remedy = "Check its video and keypoints, or remove it from the take."
        findings.append(Finding("fault", "coverage", f"No person was detected in {name}{few}.", (name,), remedy=remedy))
    return findings


def _clock_course(c: Checked) -> list[Finding]:
    """Clocks that change within the take; the views are put in step for the checks that follow."""
    moving = c.moving
    if c.quick and len(moving) < min(map(len, c.keypoints)):
        moving = make_views(c.rig, [k.rows(slice(0, _COURSE_FRAMES), k.time_offset) for k in c.keypoints])
    found, seen = changes.clock_findings(with_sides_right(moving.select(c.views.rig.names)), _first_frame(c))
    if found:
        c.views = c.moving = seen
    return found


def _first_frame(c: Checked) -> int:
    return c.observations.frames[0] if c.observations else 0


def _groups(c: Checked) -> list[Finding]:
    found = timing.group_findings(c.rig, c.keypoints, _first_frame(c))
    c.sound = not found
    return found


def _moved_within(c: Checked) -> list[Finding]:
    """Cameras that moved during the recording, which lose what they saw in their other pose."""
    _synchronise(c, c.views.rig.names)
    if c.quick and c.frames_late:  # the views are of an interval
        return []
    every = -(-min(map(len, c.keypoints)) // len(c.views)) if c.quick else 1
    frames, still = _first_frame(c) + every * np.arange(len(c.views)), _named(c, "frozen")
    found, seen = changes.move_findings(c.views, frames, still & {*c.views.rig.names})
    if found:
        c.views, c.moving = seen, c.moving if c.quick else seen
        _synchronise(c, c.views.rig.names)
    return found


def _strangers(c: Checked) -> list[Finding]:
    """Cameras that agree with no other once all are synchronised, which are left out, or what explains them."""
    turned, back = rig.turn_findings(c.sampled)
    if turned and _sizes(c, back, views.meet(back)[0])[0][0].severity == "fault":  # lenses are wrong
        turned, back = [], c.sampled
    c.views, c.sampled = replace(c.views, rig=back.rig), back
    found = cameras.stranger_findings(c.sampled)
    if found:  # a mistake is certain: smaller improvements suffice
        gross = cameras.distortion_findings(c.sampled)
        found = gross or mistakes.mistake_findings(c.sampled, c.file.name, lenient=True) or found
    strange = {camera for one in found for camera in one.cameras}
    c.sound = all(one.kind == "stranger" for one in found) and len(c.views.rig) > 1
    if not c.sound:
        return [*turned, *found]
    if strange:
        _synchronise(c, [name for name in c.views.rig.names if name not in strange])
    c.x, _ = views.meet(c.sampled)
    c.sound = bool(np.isfinite(c.x).any())
    if not c.sound:
        remedy = "Point all at the same place."
        found = [*found, Finding("fault", "apart", "No two cameras see the same point.", remedy=remedy)]
    return [*turned, *found]


def _synchronise(c: Checked, names: Sequence[str]) -> None:
    """Synchronise the views of some cameras, and correct their left and right."""
    c.times, c.stepped, c.frames_late = timing.synchronised((c.moving if c.quick else c.views).select(names))
    c.views = views.with_sides_right(c.views.select(names)) if c.quick and not c.frames_late else c.stepped
    c.sampled = c.views.spread(_SAMPLE_FRAMES)


def _scale(c: Checked) -> list[Finding]:
    found, ratios, sets = _sizes(c, c.sampled, c.x)
    if found[0].severity == "fault":
        found = person.order_findings(ratios, sets) or mistakes.focal_findings(c.sampled) or found
    return found


def _sizes(c: Checked, seen: KeypointViews, x: NDArray) -> tuple[list[Finding], NDArray, list[str]]:
    """Findings on the person's size, the ratios of bones to the body's that they are of, and the keypoint sets."""
    sets = list(dict.fromkeys(k.keypoint_set for k in c.keypoints))
    body = load_body(c.body) if isinstance(c.body, str) else c.body
    ratios = person.bone_ratios(body, sets, seen, x)
    return person.size_findings(person.stature(body, ratios), c.height), ratios, sets


def _clocks(c: Checked) -> list[Finding]:
    offsets = {entry.name: entry.time_offset for entry in c.take.cameras} if c.take else {}
    found = timing.time_findings(c.times, offsets, timing.fast_pixels(c.stepped), confirmed=bool(c.frames_late))
    known = _named(c, "rate", "kicked")  # a drift, or too few frames
    return [f for f in found if f.severity in ("fault", "good") or not f.cameras or not {*f.cameras} <= known]


def _biases(c: Checked) -> list[Finding]:
    c.biases = cameras.camera_biases(c.sampled)
    entries = sorted(c.take.keypoints if c.take else (), key=lambda entry: -entry.sigma)
    sigmas = {entry.camera: entry.sigma for entry in entries}  # the smallest of a camera's detectors
    return cameras.bias_findings(c.biases, cameras.disagreement(c.sampled), sigmas, c.file)


def _coverage(c: Checked) -> list[Finding]:
    c.coverage = rig.coverage(c.sampled, c.x)
    return rig.coverage_findings([one for one in c.coverage if one.camera not in _named(c, "kicked", "frozen")])


def _named(c: Checked, *kinds: str) -> set[str]:
    """Cameras that findings of some kinds are about."""
    return {name for found in c.findings if found.kind in kinds for name in found.cameras}


_VIEWS = ("sound", "views")
CHECKS = (
    Check("calibration", _calibration, ("take",), reads=True),
    Check("images", _pictures, ("take", "rig"), 0.3, "A dark scene looks like wider black bars."),
    Check("stated image of the keypoints", _image_frames, ("take", "rig"), reads=True),
    Check("files", _files, ("take", "sound"), 0.1, reads=True),
    Check(
        "frozen streams", _frozen, ("take", "observations"), 0.6,
        "A program that fills gaps with the last frame, and a film that was paused look the same.",
    ),
    Check(
        "covered lens", _covered, ("take", "observations"), 2.0,
        "Darkness, or an object that fills the image, looks like a covered lens.",
    ),
    Check(
        "noise of depth cameras", lambda c: images.noise_findings(c.take, c.observations.depth),
        ("take", "observations"), 2.0,
        "Sunlight, a second depth camera and a worn sensor look the same.",
    ),
    Check("notes on files", _notes, ("take", "observations"), reads=True),
    Check("person", _person, ("take", "observations"), reads=True),
    Check(
        "lens", lambda c: rig.lens_findings(c.rig), ("rig",),
        alike="A cropped image looks like a lens with another field of view or principal point.",
    ),
    Check("keypoints", _nobody, ("rig", "keypoints")),
    Check(
        "image of the keypoints", _other_frame, ("sound", "views", "take", "observations"),
        alike="Lenses calibrated at another image size look the same.",
    ),
    Check(
        "gross mistakes", _mistakes, _VIEWS, 0.1,
        "A camera that was moved far may look like a wrong sign or focal length, and a mirrored world like its images.",
    ),
    Check("person in each camera", _unseen, _VIEWS, alike="A detector that fails on a whole video looks the same."),
    Check(
        "course of the clocks", _clock_course, _VIEWS, 0.4,
        "Another person followed from then on, cut frames, and whole periods of a repeated movement look the same.",
    ),
    Check("groups", _groups, _VIEWS, 0.1, "Cameras that follow different people in one part look the same."),
    Check("cameras that move", _moved_within, _VIEWS, 0.4, "A zoom during the recording looks the same."),
    Check(
        "other cameras", _strangers, _VIEWS, 0.4,
        "The calibration or the video of another camera, and keypoints of another person look the same.",
    ),
    Check("scale", _scale, _VIEWS, alike="All focal lengths too long or too short, and a child look the same."),
    Check(
        "vertical, floor, sides of the body",
        lambda c: person.upright_findings(c.views.rig, c.x, c.views.names, c.up), _VIEWS,
        alike="A person who lies or stands on the hands, and a world mirrored together with its images look the same.",
    ),
    Check(
        "distortion", lambda c: cameras.distortion_findings(c.sampled), _VIEWS,
        alike="Several cameras that have moved a little look the same.",
    ),
    Check(
        "clocks", _clocks, _VIEWS,
        alike="A detector that smooths over time, a rolling shutter and dropped frames look the same.",
    ),
    Check(
        "bias and moved cameras", _biases, _VIEWS, 0.1,
        "Systematic errors of a detector look like biases of a few pixels; a wrong focal length like a moved camera.",
    ),
    Check("left and right", lambda c: views.side_findings(c.views), _VIEWS, alike="A mirrored image looks the same."),
    Check(
        "placement", lambda c: rig.placement_findings(c.views.rig, c.x[np.isfinite(c.x).all(-1)]), _VIEWS,
        alike="Wrong poses in the calibration look the same.",
    ),
    Check("coverage", _coverage, _VIEWS, alike="A detector that misses the person looks the same."),
)
"""All checks of which the evidence is the files and keypoints of a take, in the order in which they run."""


def _thinned(record: Keypoints) -> Keypoints:
    """A sample of the frames, spread over the recording."""
    return record.rows(slice(None, None, max(1, -(-len(record) // _SAMPLE_FRAMES))), record.time_offset)


def _most_motion(record: Keypoints, keypoints: Sequence[Keypoints]) -> Keypoints:
    """The same interval of every record: of some candidates, the one with most motion."""
    length = min(len(k) for k in keypoints)
    starts = np.unique(np.linspace(0, max(length - _QUICK_FRAMES, 0), _QUICK_INTERVALS).astype(int))
    moved = []
    for start in starts if len(starts) > 1 else ():
        detected = [k.points[start : start + _QUICK_FRAMES : 5, 0] for k in keypoints if k.points.shape[1]]
        moved.append(sum(float(np.nansum(np.minimum(np.abs(np.diff(uv, axis=0)), _MAX_JUMP_PX))) for uv in detected))
    start = int(starts[int(np.argmax(moved))]) if moved else 0
    return record.rows(slice(start, min(start + _QUICK_FRAMES, length)), record.time_offset)
