"""`check_keypoints`: what is wrong with calibrated keypoints, how sure that is, and what would mend it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, load_body
from kinefit.diagnostics.arrangement import disagreement_share, frame_findings, sample, stranger_findings
from kinefit.diagnostics.bias import CameraBias, camera_biases, disagreement
from kinefit.diagnostics.distortion import distortion_findings
from kinefit.diagnostics.groups import group_findings
from kinefit.diagnostics.mistakes import focal_findings, mistake_findings
from kinefit.diagnostics.person import size_findings, stature, upright_findings
from kinefit.diagnostics.scene import CameraCoverage, coverage, coverage_findings, lens_findings, placement_findings
from kinefit.diagnostics.sensor_fit import SensorAlignment
from kinefit.diagnostics.timing import TimeOffsets, fast_pixels, shifted, time_offsets
from kinefit.diagnostics.verdicts import bias_findings, explained, side_findings, time_findings
from kinefit.diagnostics.views import KeypointViews, make_views, meet, with_sides_right
from kinefit.errors import KinefitError
from kinefit.findings import Finding, faults_of, ranked
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations

Progress = Callable[[str, int, int], None]

_FRAMES = 240  # for what does not change over time, spread over the recording
_QUICK_FRAMES = 150  # consecutive ones that clocks are compared in, where it must be quick
_QUICK_PLACES = 5  # where these may lie, spread over the recording: where the person moves most
_LEAP = 100.0  # [px] in five frames, beyond which a point is another person's
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
    views : KeypointViews or None
        The person's keypoints, left and right put right, brought in step; of some frames alone after a quick check.
    x_world : (F, K, 3) [m] or None
        Where they meet.
    biases, coverage : one for each camera.
    times : TimeOffsets or None
    frames_late : {camera: int}
        By how many frames a camera's views were moved to bring them in step; none where empty.
    sensors : of each depth camera and marker system, how it lies against the videos.
    """

    name: str
    findings: tuple[Finding, ...] = ()
    take: Take | None = None
    observations: Observations | None = None
    views: KeypointViews | None = None
    x_world: NDArray | None = None
    biases: tuple[CameraBias, ...] = ()
    coverage: tuple[CameraCoverage, ...] = ()
    times: TimeOffsets | None = None
    frames_late: Mapping[str, int] = field(default_factory=dict)
    sensors: tuple[SensorAlignment, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that spoil results."""
        return faults_of(self.findings)

    def of(self, camera: str) -> tuple[Finding, ...]:
        """The findings about one camera."""
        return tuple(found for found in self.findings if camera in found.cameras)


def check_keypoints(
    rig: Rig,
    keypoints: Sequence[Keypoints],
    *,
    body: str | Body = "humanoid",
    up: str = "z",
    height: float | None = None,
    begun: Check | None = None,
    quick: bool = False,
    progress: Progress | None = None,
) -> Check:
    """Look for everything that is wrong with keypoints and the rig of their cameras.

    Parameters
    ----------
    rig : Rig of the cameras of the keypoints.
    keypoints : records of the same number of frames and the same rate.
    body : name or file of the body whose bone lengths give the person's height, or the body.
    up : str, vertical axis of the world.
    height : float [m] stature, where it is known.
    begun : name, take and observations that the keypoints are of, for their standard deviations, remedies and images;
        its findings are kept among the others.
    quick : bool, whether a second must do: clocks are compared in the liveliest of some stretches of the recording,
        left and right in some frames.
    """
    begun = begun or Check("take")
    take, observations = begun.take, begun.observations
    file, step = take.path if take else Path(f"{begun.name}.toml"), progress or (lambda *_: None)
    findings = [*begun.findings, *lens_findings(rig)]

    def done(what: int) -> None:
        step("checking", what, _STEPS)

    def ended(views: KeypointViews | None = None, **more: object) -> Check:
        return replace(begun, findings=ranked(findings), views=views, **more)  # type: ignore[arg-type]

    done(0)
    try:
        lively = make_views(rig, [_liveliest(k, keypoints) for k in keypoints] if quick else keypoints)
        views = make_views(rig, [_thinned(k) for k in keypoints]) if quick else lively
    except KinefitError as error:
        text = f"{error.problem[:1].upper()}{error.problem[1:]}."
        findings.append(Finding("fault", "nobody", text, remedy=error.remedy or ""))
        return ended()
    done(1)
    if take is not None and observations is not None:
        pictures = {k.camera: k.frame for k in take.keypoints if k.frame is not None}
        more, views = frame_findings(views, observations.images, pictures)
        findings += more
    gross = mistake_findings(views.spread(_FRAMES), file.name)
    if not gross:
        views, more = _seen(views)
        findings += more
        done(2)
        gross = group_findings(rig, keypoints, observations.frames[0] if observations is not None else 0)
    if not gross:
        lively = lively.select(views.rig.names) if quick else views
        times, stepped, late = _in_step(lively)
        views = with_sides_right(views) if quick and not late else stepped
        gross = stranger_findings(views.spread(_FRAMES))
        if gross:  # and something is wrong for sure
            some = views.spread(_FRAMES)
            gross = distortion_findings(some) or mistake_findings(some, file.name, lenient=True) or gross
    findings += gross
    if any(g.kind != "stranger" for g in gross) or len(views.rig) < 2:
        return ended(views)
    done(3)
    strangers = {camera for g in gross for camera in g.cameras}
    if strangers:
        rest = [n for n in views.rig.names if n not in strangers]
        times, stepped, late = _in_step(lively.select(rest))
        views = with_sides_right(views.select(rest)) if quick and not late else stepped
    some = views.spread(_FRAMES)
    x, _ = meet(some)
    if not np.isfinite(x).any():
        findings.append(
            Finding("fault", "apart", "No two cameras see a point together.", remedy="Point the cameras at one place.")
        )
        return ended(views, times=times)
    biases = camera_biases(some)
    done(4)
    sets = list(dict.fromkeys(k.keypoint_set for k in keypoints))
    size = size_findings(stature(load_body(body) if isinstance(body, str) else body, sets, some, x), height)
    findings += (focal_findings(some) if size[0].severity == "fault" else []) or size
    findings += upright_findings(views.rig, x, views.names, up)
    done(5)
    findings += distortion_findings(some)
    offsets = {c.name: c.time_offset for c in take.cameras} if take else {}
    findings += time_findings(times, offsets, fast_pixels(stepped), confirmed=bool(late))
    findings += bias_findings(biases, disagreement(some) if len(views.rig) > 2 else None, _sigmas(take), file)
    findings += side_findings(views) + placement_findings(views.rig, x[np.isfinite(x).all(-1)])
    covered = coverage(some, x)
    findings += coverage_findings(covered)
    done(_STEPS)
    findings = explained(findings)
    whole = None if quick else meet(views)[0]
    return ended(views, x_world=whole, biases=biases, coverage=covered, times=times, frames_late=late)


def _sigmas(take: Take | None) -> dict[str, float]:
    """[px] of each camera's keypoints, the least of its detectors'; empty without a take."""
    entries = sorted(take.keypoints if take else (), key=lambda entry: -entry.sigma)
    return {entry.camera: entry.sigma for entry in entries}


def _thinned(record: Keypoints) -> Keypoints:
    """Some frames, spread over the recording."""
    return record.rows(slice(None, None, max(1, -(-len(record) // _FRAMES))), record.time_offset)


def _liveliest(record: Keypoints, keypoints: Sequence[Keypoints]) -> Keypoints:
    """The same stretch of every record: of some places, the one where most moves."""
    length = min(len(k) for k in keypoints)
    starts = np.unique(np.linspace(0, max(length - _QUICK_FRAMES, 0), _QUICK_PLACES).astype(int))
    moved = []
    for start in starts if len(starts) > 1 else ():
        seen = [k.points[start : start + _QUICK_FRAMES : 5, 0] for k in keypoints if k.points.shape[1]]
        moved.append(sum(float(np.nansum(np.minimum(np.abs(np.diff(uv, axis=0)), _LEAP))) for uv in seen))
    start = int(starts[int(np.argmax(moved))]) if moved else 0
    return record.rows(slice(start, min(start + _QUICK_FRAMES, length)), record.time_offset)


def _seen(views: KeypointViews) -> tuple[KeypointViews, list[Finding]]:
    """The views of the cameras that saw somebody, and which did not."""
    seen = np.isfinite(views.uv).any(axis=(0, 1, 3))
    out = []
    for name in (n for n, s in zip(views.rig.names, seen, strict=True) if not s):
        remedy = "Check its video and keypoints; or leave it out of the take."
        out.append(Finding("fault", "coverage", f"Nobody was detected in {name}.", (name,), remedy=remedy))
    return views.select([n for n, s in zip(views.rig.names, seen, strict=True) if s]), out


def _in_step(views: KeypointViews) -> tuple[TimeOffsets, KeypointViews, dict[str, int]]:
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


def _unmoved(views: KeypointViews, moved: KeypointViews, delays: NDArray) -> KeypointViews:
    """The views as they came, with the sides exchanged that were found exchanged once they were in step."""
    uv, swapped = views.uv.copy(), views.swapped.copy()
    for c, delay in enumerate(delays.astype(int)):
        frames = np.flatnonzero(moved.swapped[:, c]) - delay
        frames = frames[(frames >= 0) & (frames < len(views))]
        uv[frames, :, c] = uv[frames[:, None], views.partner, c]
        swapped[frames, c] = True
    return replace(views, uv=uv, swapped=swapped)
