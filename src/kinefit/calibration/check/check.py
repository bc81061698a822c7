"""`check_take`: what is wrong with a recording, in plain words, how sure that is, and what would mend it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import load_body
from kinefit.calibration.check.arrangement import disagreement_share, mistake_findings, sample, stranger_findings
from kinefit.calibration.check.bias import CameraBias, camera_biases, disagreement
from kinefit.calibration.check.findings import Finding, ranked
from kinefit.calibration.check.frames import frame_findings
from kinefit.calibration.check.loading import load_leniently
from kinefit.calibration.check.person import size_findings, stature, upright_findings
from kinefit.calibration.check.scene import Coverage, coverage, coverage_findings, lens_findings, placement_findings
from kinefit.calibration.check.sensor_fit import SensorFit
from kinefit.calibration.check.sensor_verdicts import sensor_findings
from kinefit.calibration.check.sensors import fit_sensors
from kinefit.calibration.check.timing import TimeOffsets, fast_pixels, shifted, time_offsets
from kinefit.calibration.check.verdicts import bias_findings, explained, side_findings, time_findings
from kinefit.calibration.check.views import Views, make_views, meet, with_sides_right
from kinefit.errors import KinefitError, command
from kinefit.geometry.camera import Rig
from kinefit.multiview.followed import Followed, follow
from kinefit.observations import Keypoints
from kinefit.readers.take.checks import ONE_CAMERA
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import Observations
from kinefit.readers.take.one_camera import is_alone
from kinefit.readers.take.pictures import TakePictures

Progress = Callable[[str, int, int], None]

_FRAMES = 240  # for what does not change over time, spread over the recording
_SHOWS_MOST = "moving"  # of several people: who stands still shows cameras little of the volume, and clocks nothing
_STEPS = 6


@dataclass(frozen=True, eq=False)
class Check:
    """What a check found and measured.

    Parameters
    ----------
    name : str
        Of the take.
    findings : tuple of Finding, worst first.
    take : Take or None
        As it could be read: where something did not fit, with the remedy that the finding names.
    observations : Observations or None
    views : Views or None
        The person's keypoints, left and right put right, brought in step.
    x_world : (F, K, 3) [m] or None
        Where they meet.
    biases, coverage : one for each camera.
    times : TimeOffsets or None
    frames_late : {camera: int}
        By how many frames a camera's views were moved to bring them in step; none where empty.
    sensors : of each depth camera and marker system, how it lies against the videos.
    """

    name: str
    findings: tuple[Finding, ...]
    take: Take | None = None
    observations: Observations | None = None
    views: Views | None = None
    x_world: NDArray | None = None
    biases: tuple[CameraBias, ...] = ()
    coverage: tuple[Coverage, ...] = ()
    times: TimeOffsets | None = None
    frames_late: Mapping[str, int] = field(default_factory=dict)
    sensors: tuple[SensorFit, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that spoil results."""
        return tuple(found for found in self.findings if found.severity == "fault")

    def of(self, camera: str) -> tuple[Finding, ...]:
        """The findings about one camera."""
        return tuple(found for found in self.findings if camera in found.cameras)


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
    accuracy: dict[str, float] = {}
    for entry in loaded.take.keypoints:
        accuracy[entry.camera] = min(entry.sigma, accuracy.get(entry.camera, np.inf))
    rig = seen.rig
    with TakePictures(loaded.take, seen) as pictures:
        one = follow(rig, seen.keypoints, take.person or _SHOWS_MOST, pictures=pictures)
    seen = replace(seen, keypoints=one.keypoints)
    check = check_keypoints(
        rig.select(tuple(n for n in rig.names if n in accuracy)), seen.keypoints, body=take.body, up=take.up,
        height=take.height, accuracy=accuracy, name=take.name, take=loaded.take, observations=seen,
        found=(*loaded.findings, *_others(one, take.person is not None)), progress=progress,
    )  # fmt: skip
    return _with_sensors(check, progress)


def _others(one: Followed, asked: bool) -> list[Finding]:
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
    fits: tuple[SensorFit, ...] = ()
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


def check_keypoints(
    rig: Rig,
    keypoints: tuple[Keypoints, ...] | list[Keypoints],
    *,
    body: str = "humanoid",
    up: str = "z",
    height: float | None = None,
    accuracy: dict[str, float] | None = None,
    name: str = "take",
    take: Take | None = None,
    observations: Observations | None = None,
    found: tuple[Finding, ...] = (),
    progress: Progress | None = None,
) -> Check:
    """The same for keypoints and a rig in hand.

    Parameters
    ----------
    rig : Rig of the cameras of the keypoints.
    keypoints : records of the same number of frames and the same rate.
    body : str, name or file of the body that tells bone lengths.
    up : str, vertical axis of the world.
    height : float [m] stature, where it is known.
    accuracy : {camera: [px]} of the keypoints; default 8.
    found : findings made before, kept among the others.
    """
    file, step = take.path if take else Path(f"{name}.toml"), progress or (lambda *_: None)
    findings, known = list(found) + lens_findings(rig), {"take": take, "observations": observations}

    def told(done: int) -> None:
        step("checking", done, _STEPS)

    told(0)
    try:
        views = make_views(rig, keypoints)
    except KinefitError as error:
        findings.append(
            Finding("fault", "nobody", f"{error.problem[:1].upper()}{error.problem[1:]}.", remedy=error.remedy or "")
        )
        return Check(name, ranked(findings), **known)  # type: ignore[arg-type]
    told(1)
    if take is not None and observations is not None:
        pictures = {k.camera: k.frame for k in take.keypoints if k.frame is not None}
        more, views = frame_findings(views, observations.images, pictures)
        findings += more
    gross = mistake_findings(views.spread(_FRAMES), file.name)
    if not gross:
        raw, more = _seen(views)
        findings += more
        told(2)
        times, views, late = _in_step(raw)
        gross = stranger_findings(views.spread(_FRAMES))
    findings += gross
    if any(g.kind != "stranger" for g in gross) or len(views.rig) < 2:
        return Check(name, ranked(findings), views=views, **known)  # type: ignore[arg-type]
    told(3)
    strangers = {camera for g in gross for camera in g.cameras}
    if strangers:
        times, views, late = _in_step(raw.select([n for n in raw.rig.names if n not in strangers]))
    x_all, _ = meet(views)
    some = views.spread(_FRAMES)
    x, _ = meet(some)
    if not np.isfinite(x).any():
        findings.append(
            Finding("fault", "apart", "No two cameras see a point together.", remedy="Point the cameras at one place.")
        )
        return Check(name, ranked(findings), views=views, times=times, **known)  # type: ignore[arg-type]
    biases = camera_biases(some)
    told(4)
    findings += bias_findings(biases, disagreement(some) if len(views.rig) > 2 else None, accuracy or {}, file)
    offsets = {c.name: c.time_offset for c in take.cameras} if take else {}
    findings += time_findings(times, offsets, fast_pixels(some)) + side_findings(views)
    told(5)
    findings += placement_findings(views.rig, x[np.isfinite(x).all(-1)]) + upright_findings(
        views.rig, x, views.names, up
    )
    sets = list(dict.fromkeys(k.keypoint_set for k in keypoints))
    findings += size_findings(stature(load_body(body), sets, some, x), height)
    covered = coverage(some, x)
    findings += coverage_findings(covered)
    told(_STEPS)
    findings = explained(findings)
    return Check(name, ranked(findings), take, observations, views, x_all, biases, covered, times, late)


def _seen(views: Views) -> tuple[Views, list[Finding]]:
    """The views of the cameras that saw somebody, and which did not."""
    seen = np.isfinite(views.uv).any(axis=(0, 1, 3))
    out = []
    for name in (n for n, s in zip(views.rig.names, seen, strict=True) if not s):
        remedy = "Check its video and keypoints; or leave it out of the take."
        out.append(Finding("fault", "coverage", f"Nobody was detected in {name}.", (name,), remedy=remedy))
    return views.select([n for n, s in zip(views.rig.names, seen, strict=True) if s]), out


def _in_step(views: Views) -> tuple[TimeOffsets, Views, dict[str, int]]:
    """Time offsets, and the views with left and right put right and brought in step where that is sure.

    Sides can only be told of cameras in step, offsets only of points with their right names; two rounds do both.
    """
    right = with_sides_right(views)
    times = time_offsets(right)
    late = np.where(np.isfinite(times.frames) & (times.std * times.rate < 0.25), times.frames, 0.0)
    late = np.where(np.abs(late) > 0.75, late, 0.0)
    if not late.any():
        return times, right, {}
    delays = np.round(late + (views.begins - np.median(views.begins)) * views.rate)
    moved = with_sides_right(shifted(views, delays))
    if disagreement_share(moved.rig, sample(moved)) > disagreement_share(right.rig, sample(right)):
        return times, right, {}
    again = time_offsets(_unmoved(views, moved, delays) if moved.swapped.any() else right)
    return again, moved, dict(zip(views.rig.names, delays.astype(int).tolist(), strict=True))


def _unmoved(views: Views, moved: Views, delays: NDArray) -> Views:
    """The views as they came, with the sides exchanged that were found exchanged once they were in step."""
    uv, swapped = views.uv.copy(), views.swapped.copy()
    for c, delay in enumerate(delays.astype(int)):
        frames = np.flatnonzero(moved.swapped[:, c]) - delay
        frames = frames[(frames >= 0) & (frames < len(views))]
        uv[frames, :, c] = uv[frames[:, None], views.partner, c]
        swapped[frames, c] = True
    return replace(views, uv=uv, swapped=swapped)
