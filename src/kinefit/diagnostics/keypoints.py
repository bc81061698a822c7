"""Check calibrated keypoints: each finding states what is wrong, the confidence, and the remedy."""

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
from kinefit.diagnostics.person import bone_ratios, order_findings, size_findings, stature, upright_findings
from kinefit.diagnostics.scene import CameraCoverage, coverage, coverage_findings, lens_findings, placement_findings
from kinefit.diagnostics.sensor_fit import SensorAlignment
from kinefit.diagnostics.timing import TimeOffsets, fast_pixels, shifted, time_offsets
from kinefit.diagnostics.verdicts import bias_findings, explained, side_findings, time_findings
from kinefit.diagnostics.views import MIN_CONFIDENCE, KeypointViews, make_views, meet, with_sides_right
from kinefit.errors import KinefitError
from kinefit.findings import Finding, faults_of, ranked
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations

Progress = Callable[[str, int, int], None]

_SAMPLE_FRAMES = 240  # spread over the recording, for properties that are constant over time
_QUICK_FRAMES = 150  # consecutive frames in which a quick check compares clocks
_QUICK_INTERVALS = 5  # candidates for these, spread over the recording: the one with most motion is used
_MAX_JUMP_PX = 100.0  # in five frames; a larger one is to another person
_PROGRESS_STEPS = 6


@dataclass(frozen=True, eq=False)
class Check:
    """Findings and measurements of a check.

    Parameters
    ----------
    name : str
        Of the take.
    findings : tuple of Finding, worst first.
    take : Take or None
        As read, with the remedies of the findings applied where entries did not fit.
    observations : Observations or None
    views : KeypointViews or None
        The person's keypoints, with left and right corrected and cameras synchronised; a sample of the frames after a
        quick check.
    x_world : (F, K, 3) [m] or None
        Triangulated keypoints.
    biases, coverage : one for each camera.
    times : TimeOffsets or None
    frames_late : {camera: int}
        Number of frames by which a camera's views were shifted to synchronise them; empty if none were.
    sensors : alignment of each depth camera and marker system with the videos.
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
        """Findings of the severity "fault"."""
        return faults_of(self.findings)

    def of(self, camera: str) -> tuple[Finding, ...]:
        """Findings about one camera."""
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
    """Run all checks on keypoints and the rig of their cameras.

    Parameters
    ----------
    rig : Rig of the cameras of the keypoints.
    keypoints : records of the same number of frames and the same rate.
    body : the body, or its name or file; its bone lengths give the person's height.
    up : str, vertical axis of the world.
    height : float [m] stature; None if unknown.
    begun : Check with name, take and observations of the keypoints, for standard deviations, remedies and images. Its
        findings are kept.
    quick : bool, whether to finish within a second: clocks are compared in the interval with most motion, left and
        right in a sample of the frames.
    progress : called with an action, the steps done and their number.
    """
    begun = begun or Check("take")
    take, observations = begun.take, begun.observations
    file, step = take.path if take else Path(f"{begun.name}.toml"), progress or (lambda *_: None)
    findings = [*begun.findings, *lens_findings(rig)]

    def done(what: int) -> None:
        step("checking", what, _PROGRESS_STEPS)

    def ended(views: KeypointViews | None = None, **more: object) -> Check:
        return replace(begun, findings=ranked(findings), views=views, **more)  # type: ignore[arg-type]

    done(0)
    try:
        moving = make_views(rig, [_most_motion(k, keypoints) for k in keypoints] if quick else keypoints)
        views = make_views(rig, [_thinned(k) for k in keypoints]) if quick else moving
    except KinefitError as error:
        text = f"{error.problem[:1].upper()}{error.problem[1:]}."
        findings.append(Finding("fault", "nobody", text, remedy=error.remedy or ""))
        return ended()
    done(1)
    if take is not None and observations is not None:
        pictures = {k.camera: k.frame for k in take.keypoints if k.frame is not None}
        more, views = frame_findings(views, observations.images, pictures)
        findings += more
    gross = mistake_findings(views.spread(_SAMPLE_FRAMES), file.name)
    if not gross:
        views, more = _with_person(views, keypoints)
        findings += more
        if not len(views.rig):
            return ended()
        done(2)
        gross = group_findings(rig, keypoints, observations.frames[0] if observations is not None else 0)
    if not gross:
        moving = moving.select(views.rig.names) if quick else views
        times, stepped, late = _synchronised(moving)
        views = with_sides_right(views) if quick and not late else stepped
        gross = stranger_findings(views.spread(_SAMPLE_FRAMES))
        if gross:  # a mistake is certain: smaller improvements suffice
            sampled = views.spread(_SAMPLE_FRAMES)
            gross = distortion_findings(sampled) or mistake_findings(sampled, file.name, lenient=True) or gross
    findings += gross
    if any(g.kind != "stranger" for g in gross) or len(views.rig) < 2:
        return ended(views)
    done(3)
    stranger_names = {camera for g in gross for camera in g.cameras}
    if stranger_names:
        rest = [n for n in views.rig.names if n not in stranger_names]
        times, stepped, late = _synchronised(moving.select(rest))
        views = with_sides_right(views.select(rest)) if quick and not late else stepped
    sampled = views.spread(_SAMPLE_FRAMES)
    x, _ = meet(sampled)
    if not np.isfinite(x).any():
        findings.append(
            Finding("fault", "apart", "No two cameras see the same point.", remedy="Point all at the same place.")
        )
        return ended(views, times=times)
    biases = camera_biases(sampled)
    done(4)
    sets = list(dict.fromkeys(k.keypoint_set for k in keypoints))
    body = load_body(body) if isinstance(body, str) else body
    ratios = bone_ratios(body, sets, sampled, x)
    size = size_findings(stature(body, ratios), height)
    if size[0].severity == "fault":
        size = order_findings(ratios, sets) or focal_findings(sampled) or size
    findings += size
    findings += upright_findings(views.rig, x, views.names, up)
    done(5)
    findings += distortion_findings(sampled)
    offsets = {c.name: c.time_offset for c in take.cameras} if take else {}
    findings += time_findings(times, offsets, fast_pixels(stepped), confirmed=bool(late))
    findings += bias_findings(biases, disagreement(sampled) if len(views.rig) > 2 else None, _sigmas(take), file)
    findings += side_findings(views) + placement_findings(views.rig, x[np.isfinite(x).all(-1)])
    covered = coverage(sampled, x)
    findings += coverage_findings(covered)
    done(_PROGRESS_STEPS)
    findings = explained(findings)
    whole = None if quick else meet(views)[0]
    return ended(views, x_world=whole, biases=biases, coverage=covered, times=times, frames_late=late)


def _sigmas(take: Take | None) -> dict[str, float]:
    """Sigma [px] of each camera's keypoints, the smallest of its detectors; empty without a take."""
    entries = sorted(take.keypoints if take else (), key=lambda entry: -entry.sigma)
    return {entry.camera: entry.sigma for entry in entries}


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


def _with_person(views: KeypointViews, keypoints: Sequence[Keypoints]) -> tuple[KeypointViews, list[Finding]]:
    """The views of cameras in which a person was detected, and findings on the others."""
    detected = np.isfinite(views.uv).any(axis=(0, 1, 3))
    out = []
    for name in (n for n, s in zip(views.rig.names, detected, strict=True) if not s):
        highest = max(float(k.confidence.max(initial=0.0)) for k in keypoints if k.camera == name)
        few = f" with a confidence above {MIN_CONFIDENCE} (highest: {highest:.2g})" if highest > 0.0 else ""
        remedy = "Check its video and keypoints, or remove it from the take."
        out.append(Finding("fault", "coverage", f"No person was detected in {name}{few}.", (name,), remedy=remedy))
    return views.select([n for n, s in zip(views.rig.names, detected, strict=True) if s]), out


def _synchronised(views: KeypointViews) -> tuple[TimeOffsets, KeypointViews, dict[str, int]]:
    """Time offsets, and the views with left and right corrected and, where offsets are significant, synchronised.

    Sides can only be corrected in synchronised cameras, offsets only estimated from correct sides: two rounds do both.
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
    again = time_offsets(_unshifted(views, moved, delays) if moved.swapped.any() else right)
    return again, moved, dict(zip(views.rig.names, delays.astype(int).tolist(), strict=True))


def _unshifted(views: KeypointViews, moved: KeypointViews, delays: NDArray) -> KeypointViews:
    """The original views, with the sides swapped that were found swapped after synchronisation."""
    uv, swapped = views.uv.copy(), views.swapped.copy()
    for c, delay in enumerate(delays.astype(int)):
        frames = np.flatnonzero(moved.swapped[:, c]) - delay
        frames = frames[(frames >= 0) & (frames < len(views))]
        uv[frames, :, c] = uv[frames[:, None], views.partner, c]
        swapped[frames, c] = True
    return replace(views, uv=uv, swapped=swapped)
