"""From measured biases, time offsets and exchanged sides to what they mean: findings in plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from kinefit.diagnostics.bias import SHIFT, TURN, CameraBias, Disagreement
from kinefit.diagnostics.timing import TimeOffsets
from kinefit.diagnostics.views import KeypointViews
from kinefit.errors import command
from kinefit.findings import SEVERITIES, Finding, Severity, frame_ranges, listed

_ACCURACY = 8.0  # [px] of keypoints of which nothing else is said, as in a take
_SURE = 4.0  # standard errors from which a bias or an offset is there
_MIN_OFFSET_TOLD = 0.1  # [frames]
_MIN_OFFSET_DOUBT = 0.2  # [frames]
_MIN_OFFSET_FAULT = 2.0  # [frames] webcams that run freely and lag are up to 1.6 from the median in a real recording
_MIN_OFFSET_FAULT_OF_TWO = 4.0  # [frames] the same of two cameras, which have nothing to be compared with: 3.4
_MIN_SHARE_OF_LARGEST = 0.7  # of the largest offset: below, cameras seem late where the median camera is off
_UNSURE = 0.5  # [frames] standard error beyond which an offset cannot be told
_NEARLY_ALL = 0.9  # of the squared disagreement
_CLEARLY = 0.5  # of what the second best explanation leaves of it, that the best one leaves at most
_MAX_LEFT = 0.5  # of the keypoints' sigma, that the cameras which moved leave unexplained
_MAX_LEFT_CLEAR = 0.75  # where no others explain it nearly as well: of right cameras 0.6 to 0.7 are left
_OUTLIERS = 0.15  # share of a camera's points that agree with nobody: detectors stay well below


def bias_findings(
    biases: Sequence[CameraBias], parts: Disagreement | None, accuracy: Mapping[str, float], take: Path
) -> list[Finding]:
    """Cameras whose calibration is off by more than a keypoint is inaccurate, and which of them moved.

    Parameters
    ----------
    parts : Disagreement, or None where only two cameras are there.
    accuracy : {camera: [px]}
        Of the take's keypoints: a bias as large does as much harm as all their noise, and never averages out.
    take : str
        The take file, for remedies.
    """
    out: list[Finding] = []
    for b in biases:
        if b.count and np.isfinite(b.bias).all():
            out += _one_bias(b, accuracy.get(b.camera, _ACCURACY), take)
        if b.outliers > _OUTLIERS:
            text = f"{100 * b.outliers:.0f} % of {b.camera}'s points agree with no other camera."
            remedy = "Look at its keypoints (the image below): another person, a poster, or exchanged sides?"
            out.append(Finding("doubt", "outliers", text, (b.camera,), remedy=remedy))
    sizes = [b.size for b in biases if np.isfinite(b.size)]
    if parts is not None:
        noticed = any(found.kind == "bias" for found in out)
        moved = _who_moved(parts, min(accuracy.values(), default=_ACCURACY), take, noticed)
        out += [moved] if moved else []
    if sizes and not out:
        out.append(Finding(
            "good", "bias", f"The cameras agree: biases of {max(sizes):.1f} px at most, "
            f"spread {np.nanmedian([b.spread for b in biases]):.1f} px.",
        ))  # fmt: skip
    return out


def _one_bias(b: CameraBias, accuracy: float, take: Path) -> list[Finding]:
    significance = float(np.max(np.abs(b.bias) / np.maximum(b.std, 1e-9)))
    if b.size < 0.5 * accuracy or significance < (_SURE if b.size < accuracy else 0.5 * _SURE):
        return []
    is_fault = b.size >= max(accuracy, b.spread) and significance >= _SURE  # else the points' scatter does more harm
    severity: Severity = "fault" if is_fault else "doubt"
    way = " and ".join(
        f"{abs(v):.1f} px too far {names[int(v > 0)]}"
        for v, names in zip(b.bias, (("left", "right"), ("up", "down")), strict=True) if abs(v) >= 0.25 * b.size
    )  # fmt: skip
    text = (
        f"{b.camera}: the calibration places the points {way} of where the camera sees them "
        f"(bias {b.bias[0]:+.1f}, {b.bias[1]:+.1f} ± {b.std.max():.1f} px, spread {b.spread:.1f} px"
    )
    alone = (
        f"; against the other cameras alone {b.alone[0]:+.1f}, {b.alone[1]:+.1f} px"
        if np.isfinite(b.alone).all()
        else ""
    )
    words = "Sure" if significance > 2 * _SURE else "Likely" if significance >= _SURE else "Not sure"
    sure = f"{words}: {significance:.0f} standard errors, from {b.count} points"
    more = f"; more than the keypoints' standard deviation ({accuracy:g} px) and scatter" if is_fault else ""
    remedy = f"Run: {command('check', take, '--refine')}"
    return [Finding(severity, "bias", f"{text}{alone}).", (b.camera,), f"{sure}{more}.", remedy)]


def _who_moved(parts: Disagreement, accuracy: float, take: Path, noticed: bool) -> Finding | None:
    """Which cameras, if they alone had moved, would explain how all disagree.

    Where no camera was noticed by its bias, only one that explains nearly all alone is told: a wrong focal length moves
    points this way and that.
    """
    cameras = range(len(parts.cameras))
    whole = parts.explained(parts.of(*cameras))
    refine = f"Run: {command('check', take, '--refine')}"
    text = f"The cameras disagree by {whole:.1f} px (root mean square) in a way that does not change over the recording"
    for count in (1, 2):
        if len(cameras) < 2 + count:
            break
        shares = {
            which: (parts.explained(parts.of(*which)) / max(whole, 1e-9)) ** 2 for which in combinations(cameras, count)
        }
        best, second = sorted(shares, key=lambda which: -shares[which])[:2]
        alone = count == 1 and shares[best] > _NEARLY_ALL and shares[second] < 0.5 * shares[best]
        if not noticed and not (alone and whole > 0.25 * accuracy):
            return None
        clear = 1.0 - shares[best] < _CLEARLY * (1.0 - shares[second])
        left = whole * np.sqrt(max(1.0 - shares[best], 0.0))
        if left > (_MAX_LEFT_CLEAR if clear else _MAX_LEFT) * accuracy:
            continue
        names = tuple(parts.cameras[c] for c in best)
        lines = "; ".join(_how(parts, c, values) for c, values in zip(best, parts.solve(*best), strict=True))
        others = listed(parts.cameras[c] for c in second)
        sure = (
            f"{'Likely' if clear else 'A guess'}: it would explain {100 * shares[best]:.0f} % of the squared "
            f"disagreement, {others} instead {100 * shares[second]:.0f} %."
        )
        verb = "has" if count == 1 else "have"
        told = f"{text}: {listed(names)} {verb} moved or turned since the calibration ({lines})."
        return Finding("note" if noticed else "doubt", "moved", told, names, sure, refine)
    return Finding(
        "note", "moved", f"{text}; no one or two cameras explain it: the calibration as a whole is inaccurate.", (), "",
        f"{refine}; or calibrate again.",
    )  # fmt: skip


def _how(parts: Disagreement, c: int, values: np.ndarray) -> str:
    """What happened to one camera's picture: a shift, and a turn or a scale where these explain a good part."""
    focal = parts.explained(parts.of(c)) ** 2
    told = [f"{parts.cameras[c]}: shifted by {values[0]:+.1f}, {values[1]:+.1f} px"]
    if parts.explained(parts.of(c, parts=[SHIFT, TURN])) ** 2 > 1.05 * parts.explained(parts.of(c, parts=[SHIFT])) ** 2:
        told.append(f"turned about its axis by {np.degrees(values[2]):+.2f} degrees")
    if focal > 1.05 * parts.explained(parts.of(c, parts=[SHIFT, TURN])) ** 2:
        told.append(f"scaled by {100 * values[3]:+.1f} % (focal length, image size, or distance)")
    return ", ".join(told)


def time_findings(
    times: TimeOffsets, take_offsets: Mapping[str, float], whole: Mapping[str, float], *, confirmed: bool
) -> list[Finding]:
    """Cameras out of step.

    Parameters
    ----------
    take_offsets : {camera: [s]} `time_offset` as the take has it.
    whole : {camera: [px]} how far the fast points of each camera's picture move in a frame.
    confirmed : bool, whether the cameras agree better once they are moved so: one period of a motion fits like another.
    """
    out: list[Finding] = []
    known = np.isfinite(times.offsets) & (times.std * times.rate < _UNSURE)
    if not known.any():
        text = "Whether the cameras are in step cannot be determined: too little motion that several cameras see."
        return [Finding("note", "time", text, remedy="Clap, jump or swing the arms once at the start of a recording.")]
    unsure = [name for name, fine in zip(times.cameras, known, strict=True) if not fine]
    if unsure:
        verb = "is" if len(unsure) == 1 else "are"
        text = f"Whether {listed(unsure)} {verb} in step cannot be determined: too little motion."
        out.append(Finding("note", "time", text, tuple(unsure)))
    largest = float(np.max(np.abs(times.frames[known])))
    least = _MIN_OFFSET_FAULT if known.sum() > 2 else _MIN_OFFSET_FAULT_OF_TWO
    for c in np.flatnonzero(known):
        name, late, std = times.cameras[c], times.frames[c], times.std[c] * times.rate
        if abs(late) < max(_MIN_OFFSET_TOLD, _SURE * std):
            continue
        value = take_offsets.get(name, 0.0) + times.offsets[c]
        way = "later" if late > 0 else "earlier"
        text = (
            f"{name} runs {abs(late):.2f} ± {std:.2f} frames ({1e3 * abs(times.offsets[c]):.0f} ms) {way} than the "
            f"take says: a fast point is {abs(late) * whole.get(name, np.nan):.0f} px off by that."
        )
        is_fault = confirmed and abs(late) >= max(least + 3.0 * std, _MIN_SHARE_OF_LARGEST * largest)
        severity: Severity = "fault" if is_fault else "doubt" if abs(late) >= _MIN_OFFSET_DOUBT else "note"
        sure = "Sure" if abs(late) >= 2 * max(_MIN_OFFSET_TOLD, _SURE * std) else "Likely"
        if abs(late) < 1.0:
            sure += "; a detector that smooths over time, or a rolling shutter, can also delay by part of a frame"
        out.append(Finding(
            severity, "time", text, (name,), f"{sure}.",
            f"Write time_offset = {value:.4f} into [[camera]] {name}.",
        ))  # fmt: skip
    if not out:
        worst = float(np.max(np.abs(times.frames[known])))
        std = float(np.max(times.std[known])) * times.rate
        out.append(Finding("good", "time", f"The cameras are in step to {max(worst, std):.2f} frames (± {std:.2f})."))
    return out


def side_findings(views: KeypointViews) -> list[Finding]:
    """Where the detector took left for right."""
    if len(views.rig) < 3:
        return [Finding("note", "sides", "With two cameras it is undecided which of them takes left for right.")]
    found = {name: np.flatnonzero(views.swapped[:, c]) for c, name in enumerate(views.rig.names)}
    found = {name: frames for name, frames in found.items() if len(frames)}
    if not found:
        return [Finding("good", "sides", "Left and right agree in all cameras and frames.")]
    exchanges = [f"{len(f)} of {len(views)} frames of {name} ({frame_ranges(f, 6)})" for name, f in found.items()]
    most = max(found, key=lambda name: len(found[name]))
    often = len(found[most]) > 0.5 * len(views)
    remedy = (
        f"Is the image of {most} mirrored?" if often else "Nothing: tracking puts it right from the other cameras."
    )
    text = f"The detector took left for right in {listed(exchanges)}."
    sure = "Sure: exchanged, they fit the other cameras."
    return [Finding("doubt" if often else "note", "sides", text, tuple(found), sure, remedy)]


def explained(findings: Sequence[Finding]) -> list[Finding]:
    """Where one or two cameras that moved explain the biases, these are the fault, and biases notes about it."""
    moved = next((found for found in findings if found.kind == "moved" and found.cameras), None)
    if moved is None or not moved.confidence.startswith("Likely"):
        return list(findings)
    biases = [found for found in findings if found.kind == "bias" and found.cameras]
    worst = min((found.severity for found in biases if set(found.cameras) <= set(moved.cameras)),
                key=SEVERITIES.index, default=moved.severity)  # fmt: skip
    follows = f"Nothing: it follows from {listed(moved.cameras)}."
    out = [replace(f, severity="note", remedy=follows) if f in biases else f for f in findings if f is not moved]
    return [*out, replace(moved, severity=worst)]
