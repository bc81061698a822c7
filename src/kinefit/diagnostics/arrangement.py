"""Agreement of cameras: reprojection errors, the camera that disagrees, keypoints in the wrong image frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import MAX_ERROR_SHARE, KeypointViews
from kinefit.findings import Finding, listed
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.geometry.triangulation import triangulate, triangulate_robust

_SAMPLE_FRAMES = 16
_SAMPLE_POINTS = 14  # of a frame, spread over the set
FOREIGN_ERROR = 0.5
"""Mean error, as a share of the limit, of synchronised cameras whose calibration is of another session."""
_MAX_ERROR_WITHOUT = 0.5
"""Error without the odd camera, as a share of that without any other one: 0.56 and more in real recordings, 0.21 to
0.35 if a camera was rotated by 3 degrees."""
_MIN_ODD_ERROR_SHARE = 0.75  # error of the odd camera, as a share of the limit; 0.56 at most in real recordings
_MAX_OTHER_FRAME_ERROR = 0.7  # as a share of the mean error: less than a detector's noise is no evidence


def disagreement_share(rig: Rig, uv: NDArray) -> float:
    """Mean reprojection error of views (N, C, 2) [px] of points in two or more cameras, as a share 0..1 of the limit.

    Errors are clipped at the limit. 1 where no point is visible in two cameras.
    """
    limit = MAX_ERROR_SHARE * max(float(np.hypot(*camera.size)) for camera in rig)
    detected = np.isfinite(uv).all(-1)
    detected &= (detected.sum(axis=1) >= 2)[:, None]
    if not detected.any():
        return 1.0
    _, agree, residual = triangulate_robust(rig, uv, max_residual_px=limit)
    error = np.where(agree, np.nan_to_num(residual, nan=limit, posinf=limit), limit)
    return float(np.minimum(error, limit)[detected].mean() / limit)


def sample(views: KeypointViews) -> NDArray:
    """Sample (N, C, 2) [px] of the points of some frames."""
    frames = np.unique(np.linspace(0, len(views) - 1, min(_SAMPLE_FRAMES, len(views))).astype(int))
    points = np.unique(np.linspace(0, len(views.names) - 1, _SAMPLE_POINTS).astype(int))
    uv = views.uv[np.ix_(frames, points)]
    return uv.reshape(len(frames) * len(points), len(views.rig), 2)


def points_of_others(views: KeypointViews, c: int) -> NDArray:
    """Triangulate the points of `sample` without camera c: (N, 3) [m]; NaN where no two cameras agree."""
    others = [k for k in range(len(views.rig)) if k != c]
    rig = views.rig.select(tuple(views.rig.names[k] for k in others))
    return triangulate_robust(rig, sample(views)[:, others], max_residual_px=views.limit)[0]


def share_against(x_world: NDArray, camera: Camera, uv: NDArray, limit: float) -> float:
    """Median error of a camera's views (N, 2) [px] of points (N, 3) [m], clipped at the limit [px], as its share 0..1.

    0 where too few points are known.
    """
    both = np.isfinite(x_world).all(axis=1) & np.isfinite(uv).all(axis=1)
    if both.sum() < _SAMPLE_POINTS:
        return 0.0
    error = np.linalg.norm(camera.project(x_world[both]) - uv[both], axis=1)
    return float(np.median(np.minimum(np.nan_to_num(error, nan=limit), limit)) / limit)


def share_against_others(views: KeypointViews, c: int) -> float:
    """Median error, as a share 0..1 of the limit, of camera c against points triangulated by the other cameras."""
    return share_against(points_of_others(views, c), views.rig.cameras[c], sample(views)[:, c], views.limit)


def median_error(rig: Rig, uv: NDArray) -> float:
    """Median reprojection error [px] of views (N, C, 2) [px] of triangulated points; infinite where there are none."""
    uv = uv[np.isfinite(uv).all(-1).sum(axis=1) >= max(2, len(rig) - 1)]
    if not len(uv):
        return np.inf
    x = triangulate(rig, uv)
    error = np.stack([np.linalg.norm(camera.project(x) - uv[:, c], axis=-1) for c, camera in enumerate(rig)], axis=1)
    return float(np.median(np.nan_to_num(error[np.isfinite(uv).all(-1)], nan=np.inf)))


def pair_misses(views: KeypointViews) -> NDArray:
    """Median reprojection error (C, C) [px] of each pair of cameras alone; NaN where they share fewer than 4 points."""
    uv, count = sample(views), len(views.rig)
    out = np.full((count, count), np.nan)
    for a, b in combinations(range(count), 2):
        pair = views.rig.select((views.rig.names[a], views.rig.names[b]))
        both = uv[:, [a, b]][np.isfinite(uv[:, [a, b]]).all(axis=(1, 2))]
        if len(both) < 4:
            continue
        x = triangulate(pair, both)
        error = np.stack([np.linalg.norm(camera.project(x) - both[:, k], axis=-1) for k, camera in enumerate(pair)])
        out[a, b] = out[b, a] = float(np.median(np.nan_to_num(error.max(axis=0), nan=np.inf, posinf=np.inf)))
    return out


def odd_camera(views: KeypointViews) -> int | None:
    """Index of the one camera that disagrees with all others; None where there is none.

    Without it the others agree, without any other camera they do not. Needs four cameras: of three, two remain, which
    always nearly agree.
    """
    count, uv = len(views.rig), sample(views)
    if count < 4:
        return None
    without = []
    for c in range(count):
        rest = [k for k in range(count) if k != c]
        without.append(median_error(views.rig.select(tuple(views.rig.names[k] for k in rest)), uv[:, rest]))
    odd = int(np.argmin(without))
    others = min(error for c, error in enumerate(without) if c != odd)
    agrees = without[odd] > _MAX_ERROR_WITHOUT * others or share_against_others(views, odd) < _MIN_ODD_ERROR_SHARE
    return None if agrees else odd


def stranger_findings(views: KeypointViews) -> list[Finding]:
    """Findings on cameras that disagree with the others, or on a calibration of another session.

    The views must be synchronised, with gross mistakes corrected.
    """
    misses = pair_misses(views)
    bad, known = views.limit / 2, ~np.isnan(misses)
    if not known.any():
        return [
            Finding(
                "fault", "apart", "No two cameras see the same points.",
                remedy="Point the cameras at the same place, and check that their keypoints are of one recording.",
            )
        ]
    odd, names = odd_camera(views), views.rig.names
    if odd is not None:
        error = share_against_others(views, odd) * views.limit
        text = f"{names[odd]} disagrees with the other cameras: its keypoints are {error:.0f} px or more off theirs."
        return [_stranger_finding(names[odd], text)]
    agree = misses <= bad
    strange = [c for c in range(len(views.rig)) if known[c].any() and not agree[c].any()]
    rest = [name for c, name in enumerate(names) if c not in strange]
    if not agree.any() or (len(strange) > 0 and len(views.rig) > 3 and len(rest) < 3):
        return [_session_finding(views, misses)]  # two may agree by chance: a pair has one residual a point
    if len(rest) > 2 and disagreement_share(views.rig.select(tuple(rest)), sample(views.select(rest))) > FOREIGN_ERROR:
        return [_session_finding(views, misses)]
    text = "{} disagrees with every other camera: its keypoints are {:.0f} px or more off theirs."
    return [_stranger_finding(names[c], text.format(names[c], np.nanmin(misses[c]))) for c in strange]


def _stranger_finding(name: str, text: str) -> Finding:
    remedy = (
        f"{name} was moved far, has another camera's video or calibration, or tracks another person. Calibrate it "
        "again, or remove it from the take."
    )
    return Finding("fault", "stranger", text, (name,), "Certain: the other cameras agree with each other.", remedy)


def _session_finding(views: KeypointViews, misses: NDArray) -> Finding:
    least = float(np.nanmin(misses))
    agreement = (
        f"the best pair is {least:.0f} px or more apart" if np.isfinite(least) else "no two cameras see the same points"
    )
    return Finding(
        "fault", "session", f"The cameras disagree on where the person is: {agreement}.", (),
        "Certain, but not from swapped cameras, inverted poses, wrong signs, mirrored images or other focal lengths: "
        "these were tried.",
        "The calibration is of another session or of other cameras, or the keypoints are of different people. Use the "
        "calibration of this session, or calibrate again (kinefit calibrate people or board).",
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
    return [Finding("fault", "frame", text, tuple(fits), confidence, remedy)], best


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
