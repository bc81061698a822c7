"""What `track` always looks at: faults of its inputs that a second of work shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.diagnostics.images import fit_image
from kinefit.diagnostics.keypoints import Check, check_keypoints
from kinefit.diagnostics.person import size_findings
from kinefit.errors import KinefitError
from kinefit.findings import CLOCKS, FINDINGS, INVERTED, STATURE, Finding, as_records, faults_of
from kinefit.motion import UP_AXES, Motion
from kinefit.observations import Keypoints
from kinefit.readers.guess.views import nearest_axis
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations

_MIN_QUALITY = 0.5  # of a frame that shows how the person is placed
_MIN_FRAMES = 10
_MIN_INVERTED = 135.0  # [deg] median angle between trunk and vertical
_MIN_LYING = 60.0  # [deg] the same: who bends comes back
_MIN_WALK = 0.5  # [m] across the trunk: nobody goes so far lying
_MIN_LATE_S = 0.05  # of a camera's clock: a hand that gestures at 0.5 m/s is 2.5 cm off by that
_LATE_STDS = 8.0  # standard errors of the same
_STATED = ("scaled", "letterboxed")  # what the take may say of an image, and one image of the video can contradict


def input_findings(take: Take, seen: Observations, keypoints: Sequence[Keypoints], body: Body) -> tuple[Finding, ...]:
    """The faults of a take's images, cameras and keypoints, and doubts about clocks that displace a moving hand.

    Other doubts are for `kinefit check`.

    Parameters
    ----------
    take : Take
    seen : what its sensors saw.
    keypoints : of the person who is tracked.
    body : of the person, generic.
    """
    rig, findings, late = seen.rig, list[Finding](), list[Finding]()
    if rig is None or take.calibration is None:
        return ()
    for entry in take.cameras:
        if entry.image in _STATED:
            findings += fit_image(entry, rig[entry.name].size, take.rate, frames=1)[1]
    everybody, here = _with_somebody(seen.keypoints), _with_somebody(keypoints)
    shown = [k for k in keypoints if k.camera in here or k.camera not in everybody]  # a camera may see others alone
    cameras = tuple(name for name in rig.names if any(k.camera == name for k in shown))
    if len(cameras) > 1:
        begun = Check(take.name, take=take, observations=seen)
        check = check_keypoints(
            rig.select(cameras), shown, body=body, up=take.up, height=take.height, begun=begun, quick=True
        )
        findings += check.findings
        if (t := check.times) is not None:
            clear = np.abs(t.offsets) >= np.maximum(_MIN_LATE_S, _LATE_STDS * t.std)
            names = {name for name, is_late in zip(t.cameras, clear) if is_late}
            late = [f for f in check.findings if f.kind == "time" and f.severity == "doubt" and names & {*f.cameras}]
    return *faults_of(findings), *late


def _with_somebody(keypoints: Sequence[Keypoints]) -> set[str]:
    """The cameras in which anybody was detected."""
    return {k.camera for k in keypoints if np.any(k.confidence > 0.0)}


def motion_findings(motion: Motion, height: float | None) -> tuple[Finding, ...]:
    """The faults that a person's motion shows, where no two cameras do: who hangs upside down or walks lying, and size.

    A person may lie still, or stand on the hands for a while.

    Parameters
    ----------
    motion : Motion of a body whose root looks up along its y axis.
    height : float [m] stature, where it is known: then the take's own.
    """
    if not motion.body.stature:
        return ()
    good = motion.quality >= _MIN_QUALITY
    if good.sum() < _MIN_FRAMES:
        return ()
    trunk, up = motion.Ts_world_root[good, :3, 1], np.array(UP_AXES[motion.up])
    middle = np.median(trunk, axis=0)
    middle = middle / max(float(np.linalg.norm(middle)), 1e-9)
    lean = float(np.degrees(np.median(np.arccos(np.clip(trunk @ up, -1.0, 1.0)))))
    places = motion.Ts_world_root[good, :3, 3]
    way = float(np.linalg.norm(np.ptp(places - (places @ middle)[:, None] * middle, axis=0)))
    findings = list(size_findings(motion.body.stature, height))
    if lean > _MIN_INVERTED or (lean > _MIN_LYING and way > _MIN_WALK):
        how = "hangs head down" if lean > _MIN_INVERTED else f"moves {way:.1f} m lying"
        text = f'up = "{motion.up}" is wrong: the person {how}, with the trunk {lean:.0f} degrees off it.'
        remedy = f'Write up = "{nearest_axis(middle)[0]}" into [take].'
        findings.append(Finding("fault", "up", text, (), "Sure, unless that is what the person does.", remedy))
    return faults_of(findings)


def with_findings(motion: Motion, findings: Sequence[Finding], seen: Observations, height: float | None) -> Motion:
    """The motion with faults, late clocks and a stature that few adults have in its `provenance`.

    The faults of `motion_findings` are among them where it has metric sensors.
    """
    late = [f"{found.text} {found.remedy}" for found in findings if found.severity == "doubt"]
    findings = faults_of(findings)
    if len({k.camera for k in seen.keypoints}) < 2 and (seen.markers or seen.depth or seen.clouds):
        inverted = inverted_findings(motion.provenance, motion.up)
        findings = [*findings, *motion_findings(motion, height), *inverted]
    told: dict[str, Any] = {CLOCKS: late} if late else {}
    sizes = size_findings(motion.body.stature, height) if motion.body.stature and height is None else []
    if any(f.severity == "doubt" for f in sizes) and not any(f.kind == "scale" for f in findings):
        told[STATURE] = [f"{f.text} {f.remedy}" for f in sizes]
    return replace(motion, provenance={**motion.provenance, FINDINGS: as_records(findings), **told})


def inverted_findings(provenance: Mapping[str, Any], up: str) -> list[Finding]:
    """A fault where the fit of a person's size found that people hang head down in a depth camera.

    Parameters
    ----------
    provenance : of a motion, or what `tracking.sizing.sized_by_depth` reports
    up : vertical axis of the world, as the take states it
    """
    if INVERTED not in provenance:
        return []
    name, other = provenance[INVERTED], nearest_axis(-np.array(UP_AXES[up]))[0]
    text = f'up = "{up}" is wrong, or {name} hangs upside down: people are explained better the other way round.'
    remedy = f'Write up = "{other}" into [take], or turn the images by 180 degrees.'
    return [Finding("fault", "up", text, (name,), "Likely, unless the person does a handstand.", remedy)]


def with_cause(error: KinefitError, findings: Sequence[Finding]) -> KinefitError:
    """An error of tracking, with the worst fault of the inputs as its cause."""
    if not (findings := faults_of(findings)):
        return error
    first = findings[0]
    problem = f"{error.problem.rstrip('.')}; the inputs have a fault: {first.text.rstrip('.')}"
    return type(error)(problem, file=error.file, place=error.place, remedy=first.remedy or error.remedy)
