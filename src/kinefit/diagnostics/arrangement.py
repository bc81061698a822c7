"""How far cameras agree on points, which one does not, and whether calibration and keypoints fit the videos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import AGREE, KeypointViews
from kinefit.findings import Finding, listed
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.geometry.triangulation import triangulate, triangulate_robust

_FRAMES = 16
_POINTS = 14  # of a frame, spread over the set
FOREIGN = 0.5
"""Of the limit: mean error of cameras in step that have nothing to do with their calibration."""
_MAX_SHARE_WITHOUT = 0.5
"""Of the error without any other camera, that is left without the odd one: 0.56 and more of real recordings, 0.21 to
0.35 of cameras that were turned by 3 degrees."""
_MIN_SHARE_ODD = 0.75  # of the limit: error of the odd one; of real recordings 0.56 at most
_MAX_SHARE_OTHER_FRAME = 0.7  # of the cameras' mean error: a few pixels less are lost among those of a detector


def disagreement_share(rig: Rig, uv: NDArray) -> float:
    """Mean error of views (N, C, 2) [px] of points that two or more cameras see, cut at a limit, as its share."""
    limit = AGREE * max(float(np.hypot(*camera.size)) for camera in rig)
    seen = np.isfinite(uv).all(-1)
    seen &= (seen.sum(axis=1) >= 2)[:, None]
    if not seen.any():
        return 1.0
    _, agree, residual = triangulate_robust(rig, uv, max_residual_px=limit)
    error = np.where(agree, np.nan_to_num(residual, nan=limit, posinf=limit), limit)
    return float(np.minimum(error, limit)[seen].mean() / limit)


def sample(views: KeypointViews) -> NDArray:
    """(N, C, 2) [px] some points of some frames."""
    frames = np.unique(np.linspace(0, len(views) - 1, min(_FRAMES, len(views))).astype(int))
    points = np.unique(np.linspace(0, len(views.names) - 1, _POINTS).astype(int))
    return views.uv[np.ix_(frames, points)].reshape(-1, len(views.rig), 2)


def points_of_others(views: KeypointViews, c: int) -> NDArray:
    """(N, 3) [m] the points of `sample` as all cameras but c make them; NaN where no two of these agree."""
    others = [k for k in range(len(views.rig)) if k != c]
    rig = views.rig.select(tuple(views.rig.names[k] for k in others))
    return triangulate_robust(rig, sample(views)[:, others], max_residual_px=views.limit)[0]


def share_against(x_world: NDArray, camera: Camera, uv: NDArray, limit: float) -> float:
    """Median error of a camera's views (N, 2) [px] of points (N, 3) [m], cut at the limit [px], as its share."""
    both = np.isfinite(x_world).all(axis=1) & np.isfinite(uv).all(axis=1)
    if both.sum() < _POINTS:
        return 0.0
    error = np.linalg.norm(camera.project(x_world[both]) - uv[both], axis=1)
    return float(np.median(np.minimum(np.nan_to_num(error, nan=limit), limit)) / limit)


def share_against_others(views: KeypointViews, c: int) -> float:
    """The same of one camera of the rig, and the points that the others make."""
    return share_against(points_of_others(views, c), views.rig.cameras[c], sample(views)[:, c], views.limit)


def median_error(rig: Rig, uv: NDArray) -> float:
    """[px] median error of all views (N, C, 2) of the points that they make; infinite where they make none."""
    uv = uv[np.isfinite(uv).all(-1).sum(axis=1) >= max(2, len(rig) - 1)]
    if not len(uv):
        return np.inf
    x = triangulate(rig, uv)
    error = np.stack([np.linalg.norm(camera.project(x) - uv[:, c], axis=-1) for c, camera in enumerate(rig)], axis=1)
    return float(np.median(np.nan_to_num(error[np.isfinite(uv).all(-1)], nan=np.inf)))


def pair_misses(views: KeypointViews) -> NDArray:
    """(C, C) [px] median by which two cameras alone miss each other's points; NaN where they see none together."""
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
    """The one camera without which all others agree, while without any other they do not; None where there is none.

    Of four cameras or more: of three, two are left, which always nearly agree.
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
    agrees = without[odd] > _MAX_SHARE_WITHOUT * others or share_against_others(views, odd) < _MIN_SHARE_ODD
    return None if agrees else odd


def stranger_findings(views: KeypointViews) -> list[Finding]:
    """Cameras that do not agree with the others, or a rig that does not belong to the views.

    The cameras are in step, and gross mistakes are undone.
    """
    misses = pair_misses(views)
    bad, known = views.limit / 2, ~np.isnan(misses)
    if not known.any():
        return [
            Finding("fault", "apart", "No two cameras see the same points.", remedy="Point the cameras at one place.")
        ]
    odd, names = odd_camera(views), views.rig.names
    if odd is not None:
        error = share_against_others(views, odd) * views.limit
        text = f"{names[odd]} does not agree with the other cameras: it misses their points by {error:.0f} px or more."
        return [_stranger(names[odd], text)]
    agree = misses <= bad
    strange = [c for c in range(len(views.rig)) if known[c].any() and not agree[c].any()]
    rest = [name for c, name in enumerate(names) if c not in strange]
    if not agree.any() or (len(strange) > 0 and len(views.rig) > 3 and len(rest) < 3):
        return [_another_session(views, misses)]  # two may agree by chance, as a point has one way to miss another
    if len(rest) > 2 and disagreement_share(views.rig.select(tuple(rest)), sample(views.select(rest))) > FOREIGN:
        return [_another_session(views, misses)]
    text = "{} agrees with no other camera: it misses their points by {:.0f} px or more."
    return [_stranger(names[c], text.format(names[c], np.nanmin(misses[c]))) for c in strange]


def _stranger(name: str, text: str) -> Finding:
    remedy = (
        f"{name} was moved far, has another camera's video or calibration, or follows another person: calibrate it "
        "anew, or take it out of the take."
    )
    return Finding("fault", "stranger", text, (name,), "Sure: the other cameras agree with each other.", remedy)


def _another_session(views: KeypointViews, misses: NDArray) -> Finding:
    least = float(np.nanmin(misses))
    agreement = (
        f"even two of them alone miss by {least:.0f} px or more" if np.isfinite(least) else "no two of them meet at all"
    )
    return Finding(
        "fault", "session", f"The cameras do not agree on where the person is: {agreement}.", (),
        "Sure that something is wrong; exchanged cameras, inverted poses, wrong signs, mirrored images and other focal "
        "lengths were tried.",
        "The calibration is of another session or of other cameras, or the keypoints are of different people: name the "
        "calibration made with these cameras as they stood, or calibrate anew (kinefit calibrate people or board).",
    )  # fmt: skip


def frame_findings(
    views: KeypointViews, images: Mapping[str, ImageFrame], stated: Mapping[str, str]
) -> tuple[list[Finding], KeypointViews]:
    """A fault where the cameras agree far better with the keypoints in the other picture; and the views so.

    Parameters
    ----------
    views : KeypointViews with the keypoints read as the take states.
    images : {camera: ImageFrame} of the videos.
    stated : {camera: "video" or "calibration"}
        Only of cameras whose keypoints' picture the take tells.
    """
    moved = lambda name: not np.allclose(images[name].T_image_calibration, np.eye(3), atol=1e-9)
    names = [n for n in stated if n in views.rig and moved(n)]
    fits: tuple[str, ...] = ()
    best, before = views, disagreement_share(views.rig, sample(views))
    least = _MAX_SHARE_OTHER_FRAME * before
    for which in dict.fromkeys((tuple(names), *((name,) for name in names))):
        other = _otherwise(views, images, stated, which)
        share = disagreement_share(other.rig, sample(other)) if which else 1.0
        if share < least:
            best, least, fits = other, share, which
    if not fits:
        return [], views
    right = "calibration" if stated[fits[0]] == "video" else "video"
    text = f"The keypoints of {listed(fits)} are not in the {stated[fits[0]]}'s image, but in the {right}'s."
    sure = f"Sure: the cameras' mean error falls to {100 * least / before:.0f} %."
    remedy = f'Write frame = "{right}" into [[keypoints]] of {listed(fits)}.'
    return [Finding("fault", "frame", text, tuple(fits), sure, remedy)], best


def _otherwise(
    views: KeypointViews, images: Mapping[str, ImageFrame], stated: Mapping[str, str], which: tuple[str, ...]
) -> KeypointViews:
    """The views with the keypoints of some cameras in the other image than the take states."""
    uv = views.uv.copy()
    for name in which:
        c = views.rig.index(name)
        change = images[name].from_calibration if stated[name] == "video" else images[name].to_calibration
        uv[:, :, c] = change(uv[:, :, c])
    return replace(views, uv=uv)
