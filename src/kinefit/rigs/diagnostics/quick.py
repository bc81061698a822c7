"""Checks that `track` always runs: faults of its inputs that can be detected within a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.errors import KinefitError
from kinefit.findings import FINDINGS, INVERTED, NOTES, Edit, Finding, as_records, faults_of, in_words
from kinefit.observations import Keypoints
from kinefit.readers.guess.views import nearest_axis
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.rigs.diagnostics.cameras import MIN_SIGMAS
from kinefit.rigs.diagnostics.checks import CHECKS, Checked, run
from kinefit.rigs.diagnostics.person import size_findings

_MIN_QUALITY = 0.5  # of frames that are used
_MIN_FRAMES = 10  # of that quality
_MIN_INVERTED_ANGLE = 135.0  # [deg] median angle between trunk and vertical
_MIN_LYING_ANGLE = 60.0  # [deg] the same; a median, as bending is brief
_MIN_LYING_TRAVEL = 0.5  # [m] across the trunk: a lying person does not move so far
_MIN_LATE_S = 0.05  # of a camera's clock: a hand that gestures at 0.5 m/s is 2.5 cm off by that


def input_findings(take: Take, seen: Observations, keypoints: Sequence[Keypoints], body: Body) -> tuple[Finding, ...]:
    """Find faults of a take's images, cameras and keypoints, and clock errors that displace a moving hand.

    `kinefit check` reports all other doubts.

    Parameters
    ----------
    take : Take
    seen : its observations.
    keypoints : of the tracked person.
    body : of the person, generic.
    """
    rig = seen.rig
    if rig is None or take.calibration is None:
        return ()
    everybody, here = _cameras_with_people(seen.keypoints), _cameras_with_people(keypoints)
    shown = [k for k in keypoints if k.camera in here or k.camera not in everybody]  # a camera may see others only
    cameras = tuple(name for name in rig.names if any(k.camera == name for k in shown))
    checked = Checked(
        take.name, take=take, observations=seen, rig=rig.select(cameras), keypoints=shown if len(cameras) > 1 else (),
        body=body, up=take.up, height=take.height, quick=True,
    )  # fmt: skip
    found, late = run(checked, CHECKS).findings, list[Finding]()
    if (t := checked.times) is not None:
        clear = np.abs(t.offsets) >= np.maximum(_MIN_LATE_S, 2 * MIN_SIGMAS * t.std)
        names = {name for name, is_late in zip(t.cameras, clear) if is_late}
        late = [f for f in found if f.kind == "time" and f.severity == "doubt" and names & {*f.cameras}]
    return *faults_of(found), *late


def _cameras_with_people(keypoints: Sequence[Keypoints]) -> set[str]:
    """Names of the cameras in which a person was detected."""
    return {k.camera for k in keypoints if np.any(k.confidence > 0.0)}


def motion_findings(motion: Motion, height: float | None) -> tuple[Finding, ...]:
    """Find a wrong vertical or scale from a person's motion, for takes without two cameras.

    The vertical is wrong if the trunk is inverted for most of the take, or lying while the person moves. A person may
    lie still, or stand on the hands for a while.

    Parameters
    ----------
    motion : Motion of a body whose root has its y axis upwards.
    height : float [m] stature as the take states it; None if unknown.
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
    if lean > _MIN_INVERTED_ANGLE or (lean > _MIN_LYING_ANGLE and way > _MIN_LYING_TRAVEL):
        how = "hangs head down" if lean > _MIN_INVERTED_ANGLE else f"moves {way:.1f} m lying"
        text = f'up = "{motion.up}" is wrong: the person {how}, with the trunk {lean:.0f} degrees off it.'
        edit = Edit("take", "up", f'"{nearest_axis(middle)[0]}"')
        sure = "Certain, unless the person really does so."
        findings.append(Finding("fault", "up", text, (), sure, edits=(edit,)))
    return faults_of(findings)


def with_findings(motion: Motion, findings: Sequence[Finding], seen: Observations, height: float | None) -> Motion:
    """Add faults, clock errors, notes on labels and an implausible stature to a motion's `provenance`.

    With metric sensors the faults include those of `motion_findings`.

    height [m]: stature as the take states it, or None.
    """
    notes = [f"{found.text} {found.remedy}" for found in findings if found.severity == "doubt"]
    notes += [str(found) for found in findings if found.severity == "note"]
    findings = faults_of(findings)
    if len({k.camera for k in seen.keypoints}) < 2 and (seen.markers or seen.depth or seen.clouds):
        inverted = inverted_findings(motion.provenance, motion.up)
        findings = [*findings, *motion_findings(motion, height), *inverted]
    sizes = size_findings(motion.body.stature, height) if motion.body.stature and height is None else []
    if any(f.severity == "doubt" for f in sizes) and not any(f.kind == "scale" for f in findings):
        notes += [f"{f.text} {f.remedy}" for f in sizes]
    entries = {FINDINGS: as_records(findings)} | ({NOTES: notes} if notes else {})
    return replace(motion, provenance={**motion.provenance, **entries})


def inverted_findings(provenance: Mapping[str, Any], up: str) -> list[Finding]:
    """Find a depth camera that is upside down, as reported by the fit of the person's size.

    Parameters
    ----------
    provenance : of a motion, or the report of `tracking.sizing.sized_by_depth`
    up : vertical axis of the world, as the take states it
    """
    if INVERTED not in provenance:
        return []
    name, other = provenance[INVERTED], nearest_axis(-np.array(UP_AXES[up]))[0]
    text = f'up = "{up}" is wrong, or {name} is upside down: an inverted vertical fits the people better.'
    edits = (Edit("take", "up", f'"{other}"'),)
    remedy = f"Write {in_words(edits)}, or turn the images by 180 degrees."
    return [Finding("fault", "up", text, (name,), "Likely, unless the person does a handstand.", remedy, edits)]


def with_cause(error: KinefitError, findings: Sequence[Finding]) -> KinefitError:
    """Add the worst fault of the inputs to a tracking error, as its cause."""
    if not (findings := faults_of(findings)):
        return error
    first = findings[0]
    problem = f"{error.problem.rstrip('.')}; the inputs have a fault: {first.text.rstrip('.')}"
    return type(error)(problem, file=error.file, place=error.place, remedy=first.remedy or error.remedy)
