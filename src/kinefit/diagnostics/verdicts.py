"""Interpret biases, time offsets and swapped sides: findings in plain words."""

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

_DEFAULT_SIGMA_PX = 8.0  # of keypoints for which the take states none
_MIN_SIGMAS = 4.0  # standard errors of a significant bias or offset
_MIN_OFFSET_NOTE = 0.1  # [frames]
_MIN_OFFSET_DOUBT = 0.2  # [frames]
_MIN_OFFSET_FAULT = 2.0  # [frames] free-running webcams differ by up to 1.6 from the median in a real recording
_MIN_OFFSET_FAULT_OF_TWO = 4.0  # [frames] the same of two cameras, without a third to compare: 3.4
_MIN_SHARE_OF_LARGEST = 0.7  # of the largest offset: smaller ones may come from an error of the median camera
_MAX_OFFSET_SIGMA = 0.5  # [frames] standard error beyond which an offset is undetermined
_MIN_EXPLAINED_ALONE = 0.9  # share of the squared disagreement
_MAX_RESIDUAL_RATIO = 0.5  # of the best explanation to the second best
_MAX_RESIDUAL = 0.5  # [sigmas of the keypoints] that the moved cameras do not explain
_MAX_RESIDUAL_CLEAR = 0.75  # the same, if no other cameras explain it nearly as well: correct ones leave 0.6 to 0.7
_MAX_OUTLIERS = 0.15  # share of a camera's points that agree with no other camera: detectors stay well below


def bias_findings(
    biases: Sequence[CameraBias], parts: Disagreement | None, accuracy: Mapping[str, float], take: Path
) -> list[Finding]:
    """Findings on cameras with a calibration error above the keypoints' sigma, and on cameras that moved.

    Parameters
    ----------
    biases : of all cameras.
    parts : Disagreement, or None with only two cameras.
    accuracy : {camera: sigma [px]}
        Of the take's keypoints: a bias of this size does as much harm as their noise, and does not average out.
    take : Path
        The take file, for remedies.
    """
    out: list[Finding] = []
    for b in biases:
        if b.count and np.isfinite(b.bias).all():
            out += _bias_finding(b, accuracy.get(b.camera, _DEFAULT_SIGMA_PX), take)
        if b.outliers > _MAX_OUTLIERS:
            text = f"{100 * b.outliers:.0f} % of the keypoints of {b.camera} agree with no other camera."
            remedy = "Check its keypoints in the images of the page: another person, a poster, or swapped sides."
            out.append(Finding("doubt", "outliers", text, (b.camera,), remedy=remedy))
    sizes = [b.size for b in biases if np.isfinite(b.size)]
    if parts is not None:
        noticed = any(found.kind == "bias" for found in out)
        moved = _moved_cameras(parts, min(accuracy.values(), default=_DEFAULT_SIGMA_PX), take, noticed)
        out += [moved] if moved else []
    if sizes and not out:
        out.append(Finding(
            "good", "bias", f"The cameras agree: biases of {max(sizes):.1f} px at most, "
            f"spread {np.nanmedian([b.spread for b in biases]):.1f} px.",
        ))  # fmt: skip
    return out


def _bias_finding(b: CameraBias, accuracy: float, take: Path) -> list[Finding]:
    significance = float(np.max(np.abs(b.bias) / np.maximum(b.std, 1e-9)))
    if b.size < 0.5 * accuracy or significance < (_MIN_SIGMAS if b.size < accuracy else 0.5 * _MIN_SIGMAS):
        return []
    is_fault = b.size >= max(accuracy, b.spread) and significance >= _MIN_SIGMAS  # else scatter does more harm
    severity: Severity = "fault" if is_fault else "doubt"
    way = " and ".join(
        f"{abs(v):.1f} px too far {names[int(v > 0)]}"
        for v, names in zip(b.bias, (("left", "right"), ("up", "down")), strict=True) if abs(v) >= 0.25 * b.size
    )  # fmt: skip
    text = (
        f"{b.camera}: points projected with the calibration lie {way} of the keypoints "
        f"(bias {b.bias[0]:+.1f}, {b.bias[1]:+.1f} ± {b.std.max():.1f} px, spread {b.spread:.1f} px"
    )
    alone = (
        f"; against the other cameras alone {b.alone[0]:+.1f}, {b.alone[1]:+.1f} px"
        if np.isfinite(b.alone).all()
        else ""
    )
    words = "Certain" if significance > 2 * _MIN_SIGMAS else "Likely" if significance >= _MIN_SIGMAS else "Uncertain"
    confidence = f"{words}: {significance:.0f} standard errors, from {b.count} keypoints"
    more = f"; larger than the keypoints' standard deviation ({accuracy:g} px) and scatter" if is_fault else ""
    remedy = f"Run: {command('check', take, '--refine')}"
    return [Finding(severity, "bias", f"{text}{alone}).", (b.camera,), f"{confidence}{more}.", remedy)]


def _moved_cameras(parts: Disagreement, accuracy: float, take: Path, noticed: bool) -> Finding | None:
    """Find one or two cameras whose motion alone explains the disagreement of all.

    If no camera was noticed by its bias, only a camera that explains nearly all is reported: a wrong focal length
    shifts points in all directions.
    """
    cameras = range(len(parts.cameras))
    whole = parts.explained(parts.of(*cameras))
    refine = f"Run: {command('check', take, '--refine')}"
    text = f"The cameras disagree by {whole:.1f} px (root mean square), constant over the recording"
    for count in (1, 2):
        if len(cameras) < 2 + count:
            break
        shares = {
            which: (parts.explained(parts.of(*which)) / max(whole, 1e-9)) ** 2 for which in combinations(cameras, count)
        }
        best, second = sorted(shares, key=lambda which: -shares[which])[:2]
        alone = count == 1 and shares[best] > _MIN_EXPLAINED_ALONE and shares[second] < 0.5 * shares[best]
        if not noticed and not (alone and whole > 0.25 * accuracy):
            return None
        clear = 1.0 - shares[best] < _MAX_RESIDUAL_RATIO * (1.0 - shares[second])
        left = whole * np.sqrt(max(1.0 - shares[best], 0.0))
        if left > (_MAX_RESIDUAL_CLEAR if clear else _MAX_RESIDUAL) * accuracy:
            continue
        names = tuple(parts.cameras[c] for c in best)
        lines = "; ".join(_image_change(parts, c, values) for c, values in zip(best, parts.solve(*best), strict=True))
        others = listed(parts.cameras[c] for c in second)
        confidence = (
            f"{'Likely' if clear else 'A guess'}: it would explain {100 * shares[best]:.0f} % of the squared "
            f"disagreement, {others} only {100 * shares[second]:.0f} %."
        )
        verb = "has" if count == 1 else "have"
        text = f"{text}: {listed(names)} {verb} moved or rotated since the calibration ({lines})."
        return Finding("note" if noticed else "doubt", "moved", text, names, confidence, refine)
    return Finding(
        "note", "moved", f"{text}; no one or two cameras explain it: the whole calibration is inaccurate.", (), "",
        f"{refine}; or calibrate again.",
    )  # fmt: skip


def _image_change(parts: Disagreement, c: int, values: np.ndarray) -> str:
    """Describe one camera's image error: a shift, and a rotation or a scale where these explain enough."""
    focal = parts.explained(parts.of(c)) ** 2
    changes = [f"{parts.cameras[c]}: shifted by {values[0]:+.1f}, {values[1]:+.1f} px"]
    if parts.explained(parts.of(c, parts=[SHIFT, TURN])) ** 2 > 1.05 * parts.explained(parts.of(c, parts=[SHIFT])) ** 2:
        changes.append(f"rotated about its axis by {np.degrees(values[2]):+.2f} degrees")
    if focal > 1.05 * parts.explained(parts.of(c, parts=[SHIFT, TURN])) ** 2:
        changes.append(f"scaled by {100 * values[3]:+.1f} % (focal length, image size, or distance)")
    return ", ".join(changes)


def time_findings(
    times: TimeOffsets, take_offsets: Mapping[str, float], whole: Mapping[str, float], *, confirmed: bool
) -> list[Finding]:
    """Findings on cameras that are out of sync.

    Parameters
    ----------
    times : TimeOffsets
    take_offsets : {camera: [s]} `time_offset` as the take states it.
    whole : {camera: [px]} motion of the fast points per frame, see `fast_pixels`.
    confirmed : bool, whether the shifts improve the agreement of the cameras; of a periodic motion, several would fit.
    """
    out: list[Finding] = []
    known = np.isfinite(times.offsets) & (times.std * times.rate < _MAX_OFFSET_SIGMA)
    if not known.any():
        text = "Too little motion is visible in several cameras to check their clocks."
        return [Finding("note", "time", text, remedy="Clap, jump or swing the arms once at the start of a recording.")]
    undetermined = [name for name, fine in zip(times.cameras, known, strict=True) if not fine]
    if undetermined:
        text = f"Too little motion to check the clock of {listed(undetermined)}."
        out.append(Finding("note", "time", text, tuple(undetermined)))
    largest = float(np.max(np.abs(times.frames[known])))
    least = _MIN_OFFSET_FAULT if known.sum() > 2 else _MIN_OFFSET_FAULT_OF_TWO
    for c in np.flatnonzero(known):
        name, late, std = times.cameras[c], times.frames[c], times.std[c] * times.rate
        if abs(late) < max(_MIN_OFFSET_NOTE, _MIN_SIGMAS * std):
            continue
        value = take_offsets.get(name, 0.0) + times.offsets[c]
        way = "later" if late > 0 else "earlier"
        text = (
            f"{name} is {abs(late):.2f} ± {std:.2f} frames ({1e3 * abs(times.offsets[c]):.0f} ms) {way} than the take "
            f"states, which moves a fast point by {abs(late) * whole.get(name, np.nan):.0f} px."
        )
        is_fault = confirmed and abs(late) >= max(least + 3.0 * std, _MIN_SHARE_OF_LARGEST * largest)
        severity: Severity = "fault" if is_fault else "doubt" if abs(late) >= _MIN_OFFSET_DOUBT else "note"
        confidence = "Certain" if abs(late) >= 2 * max(_MIN_OFFSET_NOTE, _MIN_SIGMAS * std) else "Likely"
        if abs(late) < 1.0:
            confidence += "; but temporal smoothing in a detector, or a rolling shutter, also delays by part of a frame"
        out.append(Finding(
            severity, "time", text, (name,), f"{confidence}.",
            f"Write time_offset = {value:.4f} into [[camera]] {name}.", (("time_offset", f"{value:.4f}"),),
        ))  # fmt: skip
    if not out:
        worst = float(np.max(np.abs(times.frames[known])))
        std = float(np.max(times.std[known])) * times.rate
        out.append(Finding("good", "time", f"The cameras are synchronised to {max(worst, std):.2f} frames."))
    return out


def side_findings(views: KeypointViews) -> list[Finding]:
    """Findings on frames in which the detector swapped left and right."""
    if len(views.rig) < 3:
        return [Finding("note", "sides", "Left/right swaps cannot be assigned to a camera: only two cameras.")]
    found = {name: np.flatnonzero(views.swapped[:, c]) for c, name in enumerate(views.rig.names)}
    found = {name: frames for name, frames in found.items() if len(frames)}
    if not found:
        return [Finding("good", "sides", "No left/right swaps in any camera.")]
    exchanges = [f"{len(f)} of {len(views)} frames of {name} ({frame_ranges(f, 6)})" for name, f in found.items()]
    most = max(found, key=lambda name: len(found[name]))
    mostly = len(found[most]) > 0.5 * len(views)
    remedy = (
        f"Check whether the image of {most} is mirrored." if mostly else "Nothing: tracking corrects it."
    )
    text = f"The detector swapped left and right in {listed(exchanges)}."
    confidence = "Certain: after correction they fit the other cameras."
    return [Finding("doubt" if mostly else "note", "sides", text, tuple(found), confidence, remedy)]


def explained(findings: Sequence[Finding]) -> list[Finding]:
    """Downgrade biases to notes if one or two moved cameras explain them; the motion gets their severity."""
    moved = next((found for found in findings if found.kind == "moved" and found.cameras), None)
    if moved is None or not moved.confidence.startswith("Likely"):
        return list(findings)
    biases = [found for found in findings if found.kind == "bias" and found.cameras]
    worst = min((found.severity for found in biases if set(found.cameras) <= set(moved.cameras)),
                key=SEVERITIES.index, default=moved.severity)  # fmt: skip
    follows = f"Nothing: the motion of {listed(moved.cameras)} explains it."
    out = [replace(f, severity="note", remedy=follows) if f in biases else f for f in findings if f is not moved]
    return [*out, replace(moved, severity=worst)]
