"""Cameras that disagree: strangers, other image frames, biases and which camera moved, lens distortion left out.

The bias is the projection of the triangulated points minus their detections. It is computed in two ways: from points
that include the camera's own view (the part of its error that remains in a fit), and from points of all other cameras
(its error against them, about twice as large with four cameras).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import command
from kinefit.findings import SEVERITIES, Edit, Finding, Severity, listed
from kinefit.fitting.multiview import views as keypoint_views
from kinefit.fitting.multiview.views import KeypointViews, disagreement_share, median_error, meet, sample
from kinefit.geometry.camera import Camera, ImageFrame, Rig

FOREIGN_ERROR = 0.5
"""Mean error, as a share of the limit, of synchronised cameras whose calibration is of another session."""
_MAX_ERROR_WITHOUT = 0.5
"""Error without the odd camera, as a share of that without any other one: 0.56 and more in real recordings, 0.21 to
0.35 if a camera was rotated by 3 degrees."""
_MIN_ODD_ERROR_SHARE = 0.75  # error of the odd camera, as a share of the limit; 0.56 at most in real recordings
_MAX_OTHER_FRAME_ERROR = 0.7  # as a share of the mean error: less than a detector's noise is no evidence
SHIFT, TURN, SCALE = slice(0, 2), slice(2, 3), slice(3, 4)
PER_CAMERA = 4  # parameters of a camera's image error: shift along u and v [px], rotation [rad], scale [1]
_MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, of a normal distribution
_MIN_EIGENVALUE = 1e-6  # as a share of the largest: smaller ones are unobserved motions of all cameras together
_MAX_ERROR_RATIO = 0.8
"""Error with distortion to error without: 0.57 and 0.74 in two real recordings of wide lenses whose distortion was
removed; 0.89 and more for lenses with almost none."""
_MIN_EXPLAINED_PX = 5.0  # root mean square that distortion explains: systematic detector errors explain up to 5
_MIN_OVER_MOVED = 0.75  # of what one moved camera explains: distorted lenses 0.83 and 1.02, moved cameras up to 0.69
_MAX_K1 = 0.7  # |k1| of real lenses: fisheyes have another model
_DEFAULT_SIGMA_PX = 8.0  # of keypoints for which the take states none
MIN_SIGMAS = 4.0
"""Standard errors of a significant bias or time offset."""

_MIN_EXPLAINED_ALONE = 0.9  # share of the squared disagreement
_MAX_RESIDUAL_RATIO = 0.5  # of the best explanation to the second best
_MAX_RESIDUAL = 0.5  # [sigmas of the keypoints] that the moved cameras do not explain
_MAX_RESIDUAL_CLEAR = 0.75  # the same, if no other cameras explain it nearly as well: correct ones leave 0.6 to 0.7
_MIN_ROLL = 1.0  # [deg] of a camera about its axis; correct ones: up to 0.3 by a detector's errors
_MIN_ROLL_RATIO = 3.0  # to the second largest
_MAX_OUTLIERS = 0.15  # share of a camera's points that agree with no other camera: detectors stay well below


def odd_camera(views: KeypointViews) -> int | None:
    """Index of the one camera that disagrees with all others; None where there is none.

    Without it the others agree, without any other camera they do not. Needs four cameras: of three, two remain, which
    always nearly agree.
    """
    if len(views.rig) < 4:
        return None
    without = [median_error(rest.rig, sample(rest)) for rest in map(views.without, range(len(views.rig)))]
    odd = int(np.argmin(without))
    agrees = without[odd] > _MAX_ERROR_WITHOUT * min(without[:odd] + without[odd + 1 :])
    return None if agrees or keypoint_views.share_against_others(views, odd) < _MIN_ODD_ERROR_SHARE else odd


def stranger_findings(views: KeypointViews) -> list[Finding]:
    """Findings on cameras that disagree with the others, or on a calibration of another session.

    The views must be synchronised, with gross mistakes corrected.
    """
    misses = keypoint_views.pair_misses(views)
    bad, known = views.limit / 2, ~np.isnan(misses)
    if not known.any():
        remedy = "Point the cameras at the same place, and check that their keypoints are of one recording."
        return [Finding("fault", "apart", "No two cameras see the same points.", remedy=remedy)]
    odd, names = odd_camera(views), views.rig.names
    if odd is not None:
        error = keypoint_views.share_against_others(views, odd) * views.limit
        text = f"{names[odd]} disagrees with the other cameras: its keypoints are {error:.0f} px or more off theirs."
        return [_stranger_finding(names[odd], text)]
    agree = misses <= bad
    strange = [c for c in range(len(views.rig)) if known[c].any() and not agree[c].any()]
    rest = [name for c, name in enumerate(names) if c not in strange]
    if not agree.any() or (len(strange) > 0 and len(views.rig) > 3 and len(rest) < 3):
        return [_session_finding(misses)]  # two may agree by chance: a pair has one residual a point
    if len(rest) > 2 and disagreement_share(views.rig.select(tuple(rest)), sample(views.select(rest))) > FOREIGN_ERROR:
        return [_session_finding(misses)]
    text = "{} disagrees with every other camera: its keypoints are {:.0f} px or more off theirs."
    return [_stranger_finding(names[c], text.format(names[c], np.nanmin(misses[c]))) for c in strange]


def _stranger_finding(name: str, text: str) -> Finding:
    remedy = f"{name} was moved far, has another camera's video or calibration, or tracks another person. "
    remedy += "Calibrate it again, or remove it from the take."
    return Finding("fault", "stranger", text, (name,), "Certain: the other cameras agree with each other.", remedy)


def _session_finding(misses: NDArray) -> Finding:
    least = float(np.nanmin(misses))
    seen = np.isfinite(least)
    best = f"the best pair is {least:.0f} px or more apart" if seen else "no two cameras see the same points"
    confidence = "Certain, but not from swapped cameras, inverted poses, wrong signs, mirrored images or other focal "
    remedy = "The calibration is of another session or of other cameras, or the keypoints are of different people. Use "
    return Finding(
        "fault", "session", f"The cameras disagree on where the person is: {best}.", (),
        f"{confidence}lengths: these were tried.",
        f"{remedy}the calibration of this session, or calibrate again (kinefit calibrate people or board).",
    )  # fmt: skip


def frame_findings(
    views: KeypointViews, images: Mapping[str, ImageFrame], stated: Mapping[str, str]
) -> tuple[list[Finding], KeypointViews]:
    """Find keypoints that are in the other image frame than the take states, the video's or the calibration's.

    Parameters
    ----------
    views : KeypointViews with the keypoints read as the take states.
    images : {camera: ImageFrame} of the videos.
    stated : {camera: "video" or "calibration"}
        Only of cameras for which the take states the frame.

    Returns
    -------
    A fault if the cameras agree far better in the other frame, and the views in that frame.
    """
    moved = lambda name: not np.allclose(images[name].T_image_calibration, np.eye(3), atol=1e-9)
    names = [n for n in stated if n in views.rig and moved(n)]
    fits: tuple[str, ...] = ()
    best, before = views, disagreement_share(views.rig, sample(views))
    least = _MAX_OTHER_FRAME_ERROR * before
    for which in dict.fromkeys((tuple(names), *((name,) for name in names))):
        other = _in_other_frame(views, images, stated, which)
        share = disagreement_share(other.rig, sample(other)) if which else 1.0
        if share < least:
            best, least, fits = other, share, which
    if not fits:
        return [], views
    right = "calibration" if stated[fits[0]] == "video" else "video"
    text = f"Keypoints of {listed(fits)} are in pixels of the {right}'s image, not of the {stated[fits[0]]}'s."
    confidence = f"Certain: the cameras' mean error falls to {100 * least / before:.0f} %."
    remedy = f'Write frame = "{right}" into [[keypoints]] of {listed(fits)}.'
    edits = tuple(Edit("keypoints", "frame", f'"{right}"', name) for name in fits)
    return [Finding("fault", "frame", text, tuple(fits), confidence, remedy, edits)], best


def _in_other_frame(
    views: KeypointViews, images: Mapping[str, ImageFrame], stated: Mapping[str, str], which: tuple[str, ...]
) -> KeypointViews:
    """The views with the keypoints of some cameras in the other image frame."""
    uv = views.uv.copy()
    for name in which:
        c = views.rig.index(name)
        change = images[name].from_calibration if stated[name] == "video" else images[name].to_calibration
        uv[:, :, c] = change(uv[:, :, c])
    return replace(views, uv=uv)



@dataclass(frozen=True, eq=False)
class CameraBias:
    """Bias of one camera's keypoints.

    Parameters
    ----------
    camera : str
    bias, std : (2,) [px]
        Median of projected minus detected points, and its standard error. Each keypoint counts once, because a
        detector's error of one landmark is the same in every frame.
    alone : (2,) [px]
        Bias against points of the other cameras only; NaN if these are fewer than two.
    spread : float [px]
        Median distance of the points from the bias.
    outliers : float in 0..1
        Share of the detected points that agree with no other camera.
    count : int
        Number of compared points.
    """

    camera: str
    bias: NDArray
    std: NDArray
    alone: NDArray
    spread: float
    outliers: float
    count: int

    @property
    def size(self) -> float:
        """Length [px] of the bias."""
        return float(np.hypot(*self.bias))


def camera_biases(views: KeypointViews) -> tuple[CameraBias, ...]:
    """Bias and spread of every camera of the rig."""
    x, agree = meet(views)
    known, out = np.isfinite(x[..., 0]), []
    for c, camera in enumerate(views.rig):
        used, compared = agree[:, :, c] & known, np.isfinite(views.uv[:, :, c]).all(-1) & known
        d = np.where(used[..., None], camera.project(x) - views.uv[:, :, c], np.nan)
        bias, std = _median_bias(d)
        alone = np.full(2, np.nan)
        if len(views.rig) > 2:
            alone, _ = _median_bias(keypoint_views.from_others(views, c) - views.uv[:, :, c], limit=views.limit)
        apart = np.linalg.norm(d - bias, axis=-1)[used]
        spread = float(np.median(apart)) if len(apart) else np.nan
        outliers = 1.0 - float(used.sum() / compared.sum()) if compared.any() else np.nan
        out.append(CameraBias(camera.name, bias, std, alone, spread, outliers, int(used.sum())))
    return tuple(out)


def _median_bias(d: NDArray, *, limit: float = np.inf) -> tuple[NDArray, NDArray]:
    """Median (2,) of differences (F, K, 2) and its standard error over keypoints; NaN where there are none."""
    d = np.where((np.linalg.norm(d, axis=-1) <= limit)[..., None], d, np.nan)
    known = np.isfinite(d[..., 0])
    if not known.any():
        return np.full(2, np.nan), np.full(2, np.nan)
    medians = np.nanmedian(d[:, known.any(axis=0)], axis=0)
    spread = _MAD_TO_SIGMA * np.median(np.abs(medians - np.median(medians, axis=0)), axis=0)
    std = 1.2533 * spread / np.sqrt(max(len(medians) / 2, 1))  # of a median; left and right are correlated
    return np.median(d[known], axis=0), std


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Normal equations of the image errors of all cameras, with the points in space eliminated.

    Parameters
    ----------
    cameras : (C,) names
    matrix : (P, P), right : (P,), P = 4 C
        Of the unknown errors θ (see `PER_CAMERA`) in projected − detected ≈ D θ.
    count : int
        Degrees of freedom: pixel coordinates minus the unknowns of the points.
    """

    cameras: tuple[str, ...]
    matrix: NDArray
    right: NDArray
    count: int

    def explained(self, columns: Sequence[int] | NDArray) -> float:
        """Root mean square [px] of the disagreement that the parameters in columns (N,) alone explain."""
        if not len(columns) or not self.count:
            return 0.0
        columns = np.asarray(columns, int)
        return float(np.sqrt(max(self.right[columns] @ self.solved(columns), 0.0) / self.count))

    def solved(self, columns: Sequence[int] | NDArray) -> NDArray:
        """The parameters in columns (N,) if all others are zero, of least norm where several fit."""
        columns = np.asarray(columns, int)
        matrix, right = self.matrix[np.ix_(columns, columns)], self.right[columns]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        return scale * (np.linalg.pinv(matrix * np.outer(scale, scale), _MIN_EIGENVALUE, True) @ (scale * right))

    def of(self, *cameras: int, parts: Sequence[slice] = (SHIFT, TURN, SCALE)) -> NDArray:
        """Columns (N,) int of some cameras' parameters."""
        own = np.concatenate([np.arange(PER_CAMERA)[part] for part in parts])
        return np.concatenate([PER_CAMERA * c + own for c in cameras]) if cameras else np.zeros(0, int)

    def solve(self, *cameras: int) -> NDArray:
        """Errors (N, 4) [px, px, rad, 1] of N cameras if all other cameras are correct."""
        return self.solved(self.of(*cameras)).reshape(-1, PER_CAMERA)


def disagreement(views: KeypointViews) -> Disagreement:
    """Normal equations of each camera's image shift, rotation and scale, from the disagreement of the cameras.

    Only points that three or more cameras agree on are used, because two cameras always agree along the epipolar line.
    """

    def changes(camera: Camera, predicted: NDArray) -> NDArray:
        q = predicted - camera.matrix[:2, 2]
        shift = np.broadcast_to(np.eye(2), (len(q), 2, 2))
        return np.concatenate([shift, np.stack([-q[:, ::-1] * [1.0, -1.0], q], axis=-1)], axis=-1)

    return _equations(views, 3, changes, PER_CAMERA)


def _equations(
    views: KeypointViews, least: int, changes: Callable[[Camera, NDArray], NDArray], count: int
) -> Disagreement:
    """Normal equations of image errors, from the points that `least` cameras agree on, which are eliminated.

    changes(camera, predicted (N, 2)) (N, 2, count): derivatives of a camera's image by its parameters.
    """
    x, agree = meet(views)
    use = (agree.sum(axis=2) >= least) & np.isfinite(x[..., 0])
    x, agree, uv = x[use], agree[use], views.uv[use]
    rows, cameras = 2 * len(views.rig), len(views.rig)
    jacobian, design = np.zeros((len(x), rows, 3)), np.zeros((len(x), rows, count * cameras))
    residual = np.zeros((len(x), rows))
    for c, camera in enumerate(views.rig):
        predicted, by_point = camera.project_with_jacobian(x)
        detected, own = agree[:, c, None], slice(2 * c, 2 * c + 2)
        columns = np.where(detected[..., None], changes(camera, predicted), 0.0)
        design[:, own, count * c : count * (c + 1)] = columns
        jacobian[:, own] = np.where(detected[..., None], by_point, 0.0)
        residual[:, own] = np.where(detected, predicted - uv[:, c], 0.0)
    matrix, right = without_points(jacobian, design, residual)
    return Disagreement(views.rig.names, matrix.sum(0), right.sum(0), max(int(2 * agree.sum() - 3 * len(x)), 0))


def without_points(jacobian: NDArray, design: NDArray, residual: NDArray) -> tuple[NDArray, NDArray]:
    """Normal equations (N, P, P), (N, P) of the parameters of `design` (N, R, P), with the points eliminated.

    jacobian (N, R, 3): derivative of the residuals (N, R) by each point.
    """
    own = np.swapaxes(jacobian, 1, 2)
    inverse = np.linalg.inv(own @ jacobian + 1e-9 * np.eye(3))
    cross = own @ design
    matrix = np.swapaxes(design, 1, 2) @ design - np.swapaxes(cross, 1, 2) @ inverse @ cross
    right = np.einsum("nrp,nr->np", design, residual) - np.einsum(
        "nip,nij,nj->np", cross, inverse, np.einsum("nir,nr->ni", own, residual), optimize=True
    )
    return matrix, right



def bias_findings(
    biases: Sequence[CameraBias], parts: Disagreement, accuracy: Mapping[str, float], take: Path
) -> list[Finding]:
    """Findings on cameras with a calibration error above the keypoints' sigma, and on cameras that moved.

    Parameters
    ----------
    biases : of all cameras.
    parts : Disagreement, which counts with three cameras or more.
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
    if len(biases) > 2:
        noticed = any(found.kind == "bias" for found in out)
        out += _moved_cameras(parts, min(accuracy.values(), default=_DEFAULT_SIGMA_PX), take, noticed)
    if sizes and not out:
        spread = f"{np.nanmedian([b.spread for b in biases]):.1f} px"
        text = f"The cameras agree: biases of {max(sizes):.1f} px at most, spread {spread}."
        out.append(Finding("good", "bias", text))
    return _explained(out)


def _bias_finding(b: CameraBias, accuracy: float, take: Path) -> list[Finding]:
    significance = float(np.max(np.abs(b.bias) / np.maximum(b.std, 1e-9)))
    if b.size < 0.5 * accuracy or significance < (MIN_SIGMAS if b.size < accuracy else 0.5 * MIN_SIGMAS):
        return []
    is_fault = b.size >= max(accuracy, b.spread) and significance >= MIN_SIGMAS  # else scatter does more harm
    severity: Severity = "fault" if is_fault else "doubt"
    way = " and ".join(
        f"{abs(v):.1f} px too far {names[int(v > 0)]}"
        for v, names in zip(b.bias, (("left", "right"), ("up", "down")), strict=True) if abs(v) >= 0.25 * b.size
    )  # fmt: skip
    text = f"{b.camera}: points projected with the calibration lie {way} of the keypoints "
    text += f"(bias {b.bias[0]:+.1f}, {b.bias[1]:+.1f} ± {b.std.max():.1f} px, spread {b.spread:.1f} px"
    if np.isfinite(b.alone).all():
        text += f"; against the other cameras alone {b.alone[0]:+.1f}, {b.alone[1]:+.1f} px"
    words = "Certain" if significance > 2 * MIN_SIGMAS else "Likely" if significance >= MIN_SIGMAS else "Uncertain"
    confidence = f"{words}: {significance:.0f} standard errors, from {b.count} keypoints"
    more = f"; larger than the keypoints' standard deviation ({accuracy:g} px) and scatter" if is_fault else ""
    remedy = f"Run: {command('check', take, '--refine')}"
    return [Finding(severity, "bias", f"{text}).", (b.camera,), f"{confidence}{more}.", remedy)]


def _moved_cameras(parts: Disagreement, accuracy: float, take: Path, noticed: bool) -> list[Finding]:
    """Find one or two cameras whose motion alone explains the disagreement of all.

    If no camera was noticed by its bias, only a camera that explains nearly all is reported: a wrong focal length
    shifts points in all directions.
    """
    cameras = range(len(parts.cameras))
    whole = parts.explained(parts.of(*cameras))
    refine = f"Run: {command('check', take, '--refine')}"
    text = f"The cameras disagree by {whole:.1f} px (root mean square), constant over the recording"
    rolls = np.degrees(parts.solve(*cameras)[:, TURN.start])
    next_most, most = np.argsort(np.abs(rolls))[-2:]
    if abs(rolls[most]) > max(_MIN_ROLL, _MIN_ROLL_RATIO * abs(rolls[next_most])):
        name, text = parts.cameras[most], f"{text}: {parts.cameras[most]} is rotated about its own axis"
        confidence = f"Certain: all cameras fitted together, no other is by more than {abs(rolls[next_most]):.1f}."
        text = f"{text} by {rolls[most]:+.1f} degrees since the calibration."
        return [Finding("doubt", "moved", text, (name,), confidence, refine)]
    for count in (1, 2):
        if len(cameras) < 2 + count:
            break
        shares = {
            which: (parts.explained(parts.of(*which)) / max(whole, 1e-9)) ** 2 for which in combinations(cameras, count)
        }
        best, second = sorted(shares, key=lambda which: -shares[which])[:2]
        alone = count == 1 and shares[best] > _MIN_EXPLAINED_ALONE and shares[second] < 0.5 * shares[best]
        if not noticed and not (alone and whole > 0.25 * accuracy):
            return []
        clear = 1.0 - shares[best] < _MAX_RESIDUAL_RATIO * (1.0 - shares[second])
        left = whole * np.sqrt(max(1.0 - shares[best], 0.0))
        if left > (_MAX_RESIDUAL_CLEAR if clear else _MAX_RESIDUAL) * accuracy:
            continue
        names = tuple(parts.cameras[c] for c in best)
        lines = "; ".join(_image_change(parts, c, values) for c, values in zip(best, parts.solve(*best), strict=True))
        others = listed(parts.cameras[c] for c in second)
        confidence = f"{'Likely' if clear else 'A guess'}: it would explain {100 * shares[best]:.0f} % of the squared "
        confidence += f"disagreement, {others} only {100 * shares[second]:.0f} %."
        verb = "has" if count == 1 else "have"
        text = f"{text}: {listed(names)} {verb} moved or rotated since the calibration ({lines})."
        return [Finding("note" if noticed else "doubt", "moved", text, names, confidence, refine)]
    text = f"{text}; no one or two cameras explain it: the whole calibration is inaccurate."
    return [Finding("note", "moved", text, remedy=f"{refine}; or calibrate again.")]


def _image_change(parts: Disagreement, c: int, values: np.ndarray) -> str:
    """Describe one camera's image error: a shift, and a rotation or a scale where these explain enough."""
    shifted, turned, scaled = (
        parts.explained(parts.of(c, parts=own)) ** 2 for own in ([SHIFT], [SHIFT, TURN], [SHIFT, TURN, SCALE])
    )
    changes = [f"{parts.cameras[c]}: shifted by {values[0]:+.1f}, {values[1]:+.1f} px"]
    if turned > 1.05 * shifted:
        changes.append(f"rotated about its axis by {np.degrees(values[2]):+.2f} degrees")
    if scaled > 1.05 * turned:
        changes.append(f"scaled by {100 * values[3]:+.1f} % (focal length, image size, or distance)")
    return ", ".join(changes)


def _explained(findings: list[Finding]) -> list[Finding]:
    """Downgrade biases to notes if one or two moved cameras explain them; the motion gets their severity."""
    moved = next((f for f in findings if f.kind == "moved" and f.confidence.startswith("Likely")), None)
    if moved is None:
        return findings
    biases = [found for found in findings if found.kind == "bias" and found.cameras]
    worst = min((found.severity for found in biases if set(found.cameras) <= set(moved.cameras)),
                key=SEVERITIES.index, default=moved.severity)  # fmt: skip
    follows = f"Nothing: the motion of {listed(moved.cameras)} explains it."
    out = [replace(f, severity="note", remedy=follows) if f in biases else f for f in findings if f is not moved]
    return [*out, replace(moved, severity=worst)]



def distortion_findings(views: KeypointViews) -> list[Finding]:
    """Findings on lenses with distortion for which the calibration states none.

    Solves for one radial coefficient k1 of each of these cameras, with the points in space eliminated.
    """
    ideal = [c for c, camera in enumerate(views.rig) if not np.any(camera.distortion)]
    if len(views.rig) < 3 or not ideal:
        return []
    bending = _equations(views, 2, _bending, 1)
    k1, explained = -bending.solved(ideal), np.array([bending.explained([c]) for c in ideal])
    together, parts = bending.explained(ideal), disagreement(views)
    if together < _MIN_EXPLAINED_PX or np.max(np.abs(k1)) > _MAX_K1:
        return []
    if together < _MIN_OVER_MOVED * max(parts.explained(parts.of(c)) for c in range(len(views.rig))):
        return []
    cameras = list(views.rig)
    for c, k in zip(ideal, k1, strict=True):
        cameras[c] = replace(cameras[c], distortion=np.array([k, 0.0, 0.0, 0.0]), model="radtan")
    uv = sample(views)
    before, after = median_error(views.rig, uv), median_error(Rig(tuple(cameras)), uv)
    if not after <= _MAX_ERROR_RATIO * before:
        return []
    bent = [n for n in np.argsort(-explained) if explained[n] >= 0.5 * np.max(explained)]
    names = tuple(views.rig.names[ideal[n]] for n in bent)
    coefficients = listed(f"{name} as if k1 were {k1[n]:+.2f}" for n, name in zip(bent, names))
    text = f"The calibration has no lens distortion for {listed(names)}, but the keypoints show it: {coefficients}."
    confidence = f"Certain: with it the cameras' median error falls from {before:.1f} to {after:.1f} px."
    remedy = "Add the distortion coefficients of these lenses to the calibration."
    return [Finding("fault", "distortion", text, names, confidence, remedy)]


def _bending(camera: Camera, predicted: NDArray) -> NDArray:
    """(N, 2, 1) derivative of image points (N, 2) by the coefficient k1."""
    off = predicted - camera.matrix[:2, 2]
    return (off * np.sum(np.square(off / np.diag(camera.matrix)[:2]), axis=1, keepdims=True))[..., None]
