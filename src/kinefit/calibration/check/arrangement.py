"""Gross mistakes: exchanged cameras, inverted poses, mirrored pictures, a calibration of another session.

Each is undone on a few hundred points, and named if the cameras then agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.check.findings import Finding, listed
from kinefit.calibration.check.views import Views
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import inverse
from kinefit.geometry.triangulation import triangulate, triangulate_robust

_FRAMES = 16
_POINTS = 14  # of a frame, spread over the set
_BAD = 0.35  # of the limit, mean error of all views: cameras that are only badly calibrated stay below
_FOREIGN = 0.5  # of the limit: mean error of cameras in step that have nothing to do with their calibration
_RIGHT = 0.5  # of that error: what is left once the mistake is undone is far less
_MOST_ORDERS = 4  # cameras of which all orders are tried; of more, exchanges of two
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from x right, y up, z back (OpenGL) to x right, y down, z ahead
_REVERSED = (  # what, which axes, and whether a detector took left for right in it
    ("mirrored", "is mirrored left to right", (0,), True), ("mirrored", "is mirrored left to right", (0,), False),
    ("turned", "stands upside down", (0, 1), False),
)  # fmt: skip


@dataclass(frozen=True)
class Mistake:
    """A gross mistake that, undone, makes the cameras agree.

    Parameters
    ----------
    kind : "swapped", "poses", "mirrored" or "turned"
    cameras : those concerned; for "swapped" the cameras in the take and, in `order`, whose calibration each needs.
    before, after : mean error of all views as a share of the limit.
    """

    kind: str
    text: str
    cameras: tuple[str, ...]
    order: tuple[str, ...]
    before: float
    after: float


def disagreement_share(rig: Rig, uv: NDArray) -> float:
    """Mean error of views (N, C, 2) [px] of points that two or more cameras see, cut at a limit, as its share."""
    limit = 0.03 * max(float(np.hypot(*camera.size)) for camera in rig)
    seen = np.isfinite(uv).all(-1)
    seen &= (seen.sum(axis=1) >= 2)[:, None]
    if not seen.any():
        return 1.0
    _, agree, residual = triangulate_robust(rig, uv, max_residual_px=limit)
    error = np.where(agree, np.nan_to_num(residual, nan=limit, posinf=limit), limit)
    return float(np.minimum(error, limit)[seen].mean() / limit)


def sample(views: Views) -> NDArray:
    """(N, C, 2) [px] some points of some frames."""
    frames = np.unique(np.linspace(0, len(views) - 1, min(_FRAMES, len(views))).astype(int))
    points = np.unique(np.linspace(0, len(views.names) - 1, _POINTS).astype(int))
    return views.uv[np.ix_(frames, points)].reshape(-1, len(views.rig), 2)


def find_mistake(views: Views) -> Mistake | None:
    """The gross mistake that explains why the cameras do not agree; None where they do, or none explains it."""
    return _of_the_rig(views) or _of_one_camera(views)


def _of_one_camera(views: Views) -> Mistake | None:
    """A picture of one camera that is reversed, where the others agree: undone, it fits what they saw."""
    best: Mistake | None = None
    for c, name in enumerate(views.rig.names if len(views.rig) > 2 else ()):
        before = _beside_others(views, c)
        if before < _FOREIGN:
            continue
        for kind, text, axes, sides in _REVERSED:
            uv = views.uv.copy()
            uv[:, :, c] = uv[:, views.partner, c] if sides else uv[:, :, c]
            after = _beside_others(replace(views, uv=_mirrored(views.rig.cameras, uv, (c,), axes)), c)
            if after < _RIGHT * before and (best is None or after < 0.9 * best.after):
                best = Mistake(kind, f"{name}'s image {text}", (name,), (), before, after)
    return best


def _beside_others(views: Views, c: int) -> float:
    """Median error of one camera's views of the points that the others make, cut at a limit, as its share."""
    uv, limit = sample(views), 0.03 * max(float(np.hypot(*camera.size)) for camera in views.rig)
    others = [k for k in range(len(views.rig)) if k != c]
    rig = views.rig.select(tuple(views.rig.names[k] for k in others))
    x, _, _ = triangulate_robust(rig, uv[:, others], max_residual_px=limit)
    both = np.isfinite(x).all(axis=1) & np.isfinite(uv[:, c]).all(axis=1)
    if both.sum() < _POINTS:
        return 0.0
    error = np.linalg.norm(views.rig.cameras[c].project(x[both]) - uv[both, c], axis=1)
    return float(np.median(np.minimum(np.nan_to_num(error, nan=limit), limit)) / limit)


def _of_the_rig(views: Views) -> Mistake | None:
    """The gross mistake that makes all cameras agree."""
    uv = sample(views)
    before = disagreement_share(views.rig, uv)
    if before < _BAD:
        return None
    best: Mistake | None = None
    for mistake, rig, seen in _trials(views.rig, uv):
        after = disagreement_share(rig, seen)
        if after < _RIGHT * before and (best is None or after < 0.9 * best.after):
            best = replace(mistake, before=before, after=after)
    return best


def _trials(rig: Rig, uv: NDArray) -> Iterator[tuple[Mistake, Rig, NDArray]]:
    """What may have gone wrong, the likeliest first, each with the rig and the pixels that it would take."""

    def mistake(kind: str, text: str, cameras: tuple[str, ...] = (), order: tuple[str, ...] = ()) -> Mistake:
        return Mistake(kind, text, cameras, order, 0.0, 0.0)

    for order in _orders(len(rig)):
        moved = [c for c in range(len(rig)) if order[c] != c]
        names = tuple(rig.names[c] for c in moved)
        needed = tuple(rig.names[order[c]] for c in moved)
        cameras = Rig(tuple(replace(rig.cameras[o], name=rig.names[c]) for c, o in enumerate(order)))
        yield mistake("swapped", f"{listed(names)} are exchanged", names, needed), cameras, uv
    poses: dict[str, Callable[[NDArray], NDArray]] = {
        "the poses are camera to world, where world to camera is meant": inverse,
        "the camera axes are those of computer graphics (y up, z backward), not y down, z ahead": _FLIP.__matmul__,
        "the poses are camera to world with the axes of computer graphics (y up, z backward)":
            lambda T: _FLIP @ inverse(T),
    }  # fmt: skip
    for text, change in poses.items():
        yield mistake("poses", text), Rig(tuple(c.with_pose(change(c.T_camera_world)) for c in rig)), uv
    each = tuple(range(len(rig)))
    for axis, way in ((1, "upside down (or the world is left-handed)"), (0, "left to right (or the world is)")):
        yield mistake("mirrored", f"all images are mirrored {way}"), rig, _mirrored(rig.cameras, uv, each, (axis,))
    for (kind, text, axes, sides), (c, name) in product(_REVERSED, enumerate(rig.names)):
        if not sides:
            yield mistake(kind, f"{name}'s image {text}", (name,)), rig, _mirrored(rig.cameras, uv, (c,), axes)


def _orders(cameras: int) -> Iterator[tuple[int, ...]]:
    """Orders of the cameras but their own: exchanges of two first, then all others of a few."""
    for a, b in combinations(range(cameras), 2):
        exchanged = list(range(cameras))
        exchanged[a], exchanged[b] = b, a
        yield tuple(exchanged)
    if cameras <= _MOST_ORDERS:
        for order in permutations(range(cameras)):
            if sum(o != c for c, o in enumerate(order)) > 2:
                yield order


def _mirrored(cameras: tuple[Camera, ...], uv: NDArray, which: tuple[int, ...], axes: tuple[int, ...]) -> NDArray:
    """Pixels with some axes of some cameras' pictures reversed."""
    out = uv.copy()
    for c in which:
        for axis in axes:
            out[..., c, axis] = cameras[c].size[axis] - 1 - out[..., c, axis]
    return out


def pair_misses(views: Views) -> NDArray:
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


def mistake_findings(views: Views, take_file: str = "the take") -> list[Finding]:
    """The gross mistake, if there is one: exchanged cameras, inverted poses, mirrored pictures."""
    mistake = find_mistake(views)
    if mistake is None:
        return []
    sure = (
        f"Sure: it was tried, and the cameras' mean error falls from {100 * mistake.before:.0f} % to "
        f"{100 * mistake.after:.0f} % of the {views.limit:.0f} px within which two views count as one point."
    )
    text = _sentence(mistake.text, views.rig.names)
    return [Finding("fault", mistake.kind, text, mistake.cameras, sure, _undo(mistake, take_file))]


def stranger_findings(views: Views) -> list[Finding]:
    """Cameras that agree with no other, or a rig that does not belong to the views: in step, without gross mistakes."""
    misses = pair_misses(views)
    bad, known = views.limit / 2, ~np.isnan(misses)
    if not known.any():
        return [
            Finding("fault", "apart", "No two cameras see the same points.", remedy="Point the cameras at one place.")
        ]
    agree = misses <= bad
    strange = [c for c in range(len(views.rig)) if known[c].any() and not agree[c].any()]
    rest = [name for c, name in enumerate(views.rig.names) if c not in strange]
    if not agree.any() or (len(strange) > 0 and len(views.rig) > 3 and len(rest) < 3):
        return [_another_session(views, misses)]  # two may agree by chance, as a point has one way to miss another
    if len(rest) > 2 and disagreement_share(views.rig.select(tuple(rest)), sample(views.select(rest))) > _FOREIGN:
        return [_another_session(views, misses)]
    out = []
    for c in strange:
        name = views.rig.names[c]
        text = f"{name} agrees with no other camera: it misses their points by {np.nanmin(misses[c]):.0f} px or more."
        remedy = (
            f"{name} was moved far, has another camera's video or calibration, or follows another person: calibrate it "
            "anew, or take it out of the take."
        )
        sure = "Sure: the other cameras agree with each other."
        out.append(Finding("fault", "stranger", text, (name,), sure, remedy))
    return out


def _another_session(views: Views, misses: NDArray) -> Finding:
    least = float(np.nanmin(misses))
    told = (
        f"even two of them alone miss by {least:.0f} px or more" if np.isfinite(least) else "no two of them meet at all"
    )
    return Finding(
        "fault", "session", f"The cameras do not agree on where the person is: {told}.", (),
        "Sure that something is wrong; exchanged cameras, inverted poses and mirrored images were tried.",
        "The calibration is of another session or of other cameras, or the keypoints are of different people: name the "
        "calibration made with these cameras as they stood, or calibrate anew (kinefit calibrate people or board).",
    )  # fmt: skip


def _sentence(text: str, names: Sequence[str]) -> str:
    return (text if text.startswith(tuple(names)) else text[:1].upper() + text[1:]) + "."


def _undo(mistake: Mistake, take_file: str) -> str:
    if mistake.kind == "swapped":
        renamed = ", ".join(f"{a} to {b}" for a, b in zip(mistake.cameras, mistake.order, strict=True))
        return f"In [[camera]] and [[keypoints]] of {take_file} rename {renamed}; the calibration keeps its names."
    if mistake.kind == "poses":
        return "Export the calibration with poses from world to camera, x right, y down, z ahead (OpenCV's convention)."
    if mistake.kind == "turned":
        return f'Write rotation = 180 into [[camera]] {mistake.cameras[0]}; its keypoints are then frame = "video".'
    who = f"{mistake.cameras[0]} was" if mistake.cameras else "the images were"
    return (
        f"If {who} recorded mirrored, mirror the video back (ffmpeg -i IN -vf hflip OUT) and detect anew; if the "
        "calibration comes from a left-handed world (Unity, Unreal), export it right-handed."
    )
