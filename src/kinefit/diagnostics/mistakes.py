"""Gross mistakes: exchanged cameras, inverted poses, wrong signs, mirrored images, focal lengths of another image size.

Each is undone on a few hundred points, and named if the cameras then agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.arrangement import (
    FOREIGN,
    disagreement_share,
    odd_camera,
    points_of_others,
    sample,
    share_against,
)
from kinefit.diagnostics.views import KeypointViews
from kinefit.findings import Finding, listed
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import inverse

_MIN_SHARE = 0.25  # of the limit, mean error of all views: less than that is no gross mistake
_MAX_SHARE_LEFT = 0.5  # of that error: what is left once the mistake is undone is far less
_MAX_SHARE_LEFT_SIGN = 0.4  # of it, where one sign is changed: a small move may look like that
_MAX_SHARE_LEFT_LENIENT = 0.7  # of it, where something else shows that there is a mistake
_MAX_SHARE_LENIENT = 0.35  # of the limit, then: of real recordings without mistakes 0.06 to 0.31
_MAX_OVER_FREE_POSE = 1.65
"""Times the error at the best of all poses, that a mistake of one camera may leave once it is undone: a sign or a focal
length 0.8 to 1.6, a camera that was turned and looks as if 1.7 to 2.6."""
_MAX_OVER_FREE_POSE_IN_WORLD = 1.25  # the same of a sign of the place in the world: of turned cameras 1.3 and more
_MIN_POINTS_OF_POSE = 12  # twice the unknowns
_MAX_CAMERAS_PERMUTED = 4  # cameras of which all orders are tried; of more, exchanges of two
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from x right, y up, z back (OpenGL) to x right, y down, z ahead
_REVERSED = (  # what, which axes, and whether a detector took left for right in it
    ("mirrored", "is mirrored left to right", (0,), True), ("mirrored", "is mirrored left to right", (0,), False),
    ("turned", "stands upside down", (0, 1), False),
)  # fmt: skip
_FACTORS = (2.0, 1.5, 4 / 3, 3.0, 4.0)  # between the usual sizes of videos, 360 to 2160 lines
_ZOOMS = tuple(product((*_FACTORS, *(1 / f for f in _FACTORS)), (False, True)))  # factor, whether of the centre, too


@dataclass(frozen=True)
class Mistake:
    """A gross mistake that, undone, makes the cameras agree.

    Parameters
    ----------
    kind : "swapped", "poses", "mirrored", "turned" or "focal"
    text : what is wrong, without a stop.
    remedy : what to do.
    cameras : those concerned; none for all.
    before, after : mean error of all views as a share of the limit.
    share_left : of the error before, that at most is left once this mistake is undone.
    over_pose : times the error at the best pose, that at most is left, of one camera.
    """

    kind: str
    text: str
    remedy: str
    cameras: tuple[str, ...]
    before: float = 0.0
    after: float = 0.0
    share_left: float = _MAX_SHARE_LEFT
    over_pose: float = _MAX_OVER_FREE_POSE

    def explains(self, *, lenient: bool) -> bool:
        """Whether the cameras agree once it is undone."""
        likely = lenient and self.after <= _MAX_SHARE_LENIENT and self.after <= _MAX_SHARE_LEFT_LENIENT * self.before
        return likely or self.after < self.share_left * self.before

    def finding(self, names: Sequence[str], limit: float) -> Finding:
        """In words; `names` of all cameras, `limit` [px] of the shares."""
        word = "Sure" if self.explains(lenient=False) else "Likely"
        sure = (
            f"{word}: it was tried, and the cameras' mean error falls from {100 * self.before:.0f} % to "
            f"{100 * self.after:.0f} % of the {limit:.0f} px within which two views count as one point."
        )
        text = self.text if self.text.startswith(tuple(names)) else self.text[:1].upper() + self.text[1:]
        return Finding("fault", self.kind, f"{text}.", self.cameras, sure, self.remedy)


def mistake_findings(views: KeypointViews, take_file: str = "the take", *, lenient: bool = False) -> list[Finding]:
    """The gross mistake that explains why the cameras do not agree, if there is one.

    Parameters
    ----------
    views : KeypointViews
    take_file : name, for remedies.
    lenient : bool, whether it is known that there is a mistake, so that a smaller fall of the error will do.
    """
    mistake = _of_the_rig(views, take_file, lenient) or _of_one_camera(views, lenient)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


def focal_findings(views: KeypointViews) -> list[Finding]:
    """Focal lengths of another image size, of a person who has no human size."""
    uv = sample(views)
    trials = ((mistake, rig, uv) for mistake, rig in _focal_lengths(views.rig))
    mistake = _best(trials, disagreement_share(views.rig, uv), lenient=True)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


def _of_the_rig(views: KeypointViews, take_file: str, lenient: bool) -> Mistake | None:
    """The gross mistake that makes all cameras agree."""
    uv = sample(views)
    before = disagreement_share(views.rig, uv)
    return None if before < _MIN_SHARE else _best(_trials(views.rig, uv, take_file), before, lenient=lenient)


def _best(trials: Iterator[tuple[Mistake, Rig, NDArray]], before: float, *, lenient: bool) -> Mistake | None:
    """The trial after which the cameras agree best, if they do; the first of those that are nearly alike."""
    best: Mistake | None = None
    for mistake, rig, uv in trials:
        tried = replace(mistake, before=before, after=disagreement_share(rig, uv))
        if tried.explains(lenient=lenient) and (best is None or tried.after < 0.9 * best.after):
            best = tried
    return best


def _of_one_camera(views: KeypointViews, lenient: bool) -> Mistake | None:
    """A mistake of one camera, where the others agree: undone, it fits what they saw."""
    best: Mistake | None = None
    odd = odd_camera(views) if lenient else None
    for c, camera in enumerate(views.rig if len(views.rig) > 2 else ()):
        x_world = points_of_others(views, c)
        before = share_against(x_world, camera, sample(views)[:, c], views.limit)
        if before < FOREIGN or (odd is not None and c != odd):
            continue
        for mistake, other, uv in _trials_of_one(views, c):
            tried = replace(mistake, before=before, after=share_against(x_world, other, uv, views.limit))
            explains = tried.explains(lenient=False) or (c == odd and tried.after <= _MAX_SHARE_LEFT_LENIENT * before)
            if not explains or (best is not None and tried.after >= 0.9 * best.after):
                continue
            if tried.after <= mistake.over_pose * _share_of_free_pose(views, c, x_world):
                best = tried
    return best


def _share_of_free_pose(views: KeypointViews, c: int, x_world: NDArray) -> float:
    """Error of one camera's views of points (N, 3) [m], as `share_against` has it, at the pose that fits them best."""
    camera, uv = views.rig.cameras[c], sample(views)[:, c]
    rays = camera.ray(uv) @ camera.T_camera_world[:3, :3].T
    use = np.isfinite(x_world).all(axis=1) & np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    if use.sum() < _MIN_POINTS_OF_POSE:
        return np.inf
    found, rotation, translation, _ = cv2.solvePnPRansac(
        x_world[use], rays[use, :2] / rays[use, 2:], np.eye(3), np.zeros(4),
        reprojectionError=float(views.limit / camera.matrix[0, 0]),
    )  # fmt: skip
    if not found:
        return np.inf
    pose = se3.transform(se3.exp_so3(rotation.ravel()), translation.ravel())
    return share_against(x_world, camera.with_pose(pose), uv, views.limit)


def _trials_of_one(views: KeypointViews, c: int) -> Iterator[tuple[Mistake, Camera, NDArray]]:
    """What may be wrong with one camera, each with the camera and the pixels (N, 2) of `sample` that it would take."""
    camera, uv = views.rig.cameras[c], sample(views)[:, c]
    name = camera.name
    for kind, text, axes, sides in _REVERSED:
        seen = sample(replace(views, uv=views.uv[:, views.partner]))[:, c] if sides else uv
        yield _of_image(kind, text, name), camera, _reversed(camera, seen, axes)
    for text, change in _signs():
        remedy = f"Correct the sign in the calibration of {name}, or calibrate it anew."
        mistake = _of_sign(f"{name}: {text}", remedy, (name,))
        if "world" in text:
            mistake = replace(mistake, over_pose=_MAX_OVER_FREE_POSE_IN_WORLD)
        yield mistake, _posed(camera, change), uv
    for factor, whole in _ZOOMS:
        text = f"{name}: its focal length is about {_times(1 / factor)} what the keypoints need"
        yield Mistake("focal", text, _focal_remedy(name), (name,)), _zoomed(camera, factor, whole), uv


def _trials(rig: Rig, uv: NDArray, take_file: str) -> Iterator[tuple[Mistake, Rig, NDArray]]:
    """What may have gone wrong, the likeliest first, each with the rig and the pixels that it would take."""
    for order in _orders(len(rig)):
        moved = [c for c in range(len(rig)) if order[c] != c]
        names = tuple(rig.names[c] for c in moved)
        renamed = ", ".join(f"{rig.names[c]} to {rig.names[order[c]]}" for c in moved)
        remedy = f"In [[camera]] and [[keypoints]] of {take_file} rename {renamed}; the calibration keeps its names."
        cameras = Rig(tuple(replace(rig.cameras[o], name=rig.names[c]) for c, o in enumerate(order)))
        yield Mistake("swapped", f"{listed(names)} are exchanged", remedy, names), cameras, uv
    poses: dict[str, Callable[[NDArray], NDArray]] = {
        "the poses are camera to world, where world to camera is meant": inverse,
        "the camera axes are those of computer graphics (y up, z backward), not y down, z ahead": _FLIP.__matmul__,
        "the poses are camera to world with the axes of computer graphics (y up, z backward)":
            lambda T: _FLIP @ inverse(T),
    }  # fmt: skip
    remedy = "Export the calibration with poses from world to camera, x right, y down, z ahead (OpenCV's convention)."
    for text, change in poses.items():
        yield Mistake("poses", text, remedy, ()), Rig(tuple(_posed(c, change) for c in rig)), uv
    for text, change in _signs() if len(rig) > 2 else ():  # two cameras nearly agree whatever they are
        mistake = _of_sign(f"in all cameras {text}", "Correct the signs in the calibration, or calibrate anew.", ())
        yield mistake, Rig(tuple(_posed(c, change) for c in rig)), uv
    for axis, way in ((1, "upside down (or the world is left-handed)"), (0, "left to right (or the world is)")):
        mistake = Mistake("mirrored", f"all images are mirrored {way}", _MIRRORED.format("the images were"), ())
        yield mistake, rig, np.stack([_reversed(camera, uv[:, c], (axis,)) for c, camera in enumerate(rig)], axis=1)
    for (kind, text, axes, sides), (c, camera) in product(_REVERSED, enumerate(rig)):
        if not sides:
            seen = uv.copy()
            seen[:, c] = _reversed(camera, uv[:, c], axes)
            yield _of_image(kind, text, camera.name), rig, seen
    for mistake, zoomed in _focal_lengths(rig) if len(rig) > 2 else ():
        yield mistake, zoomed, uv


def _focal_lengths(rig: Rig) -> Iterator[tuple[Mistake, Rig]]:
    """Focal lengths of all cameras as of another image size, alone or with the principal points."""
    for factor, whole in _ZOOMS:
        text = f"the focal lengths of all cameras are about {_times(1 / factor)} what the keypoints need"
        mistake = Mistake("focal", text, _focal_remedy("the cameras"), ())
        yield mistake, Rig(tuple(_zoomed(camera, factor, whole) for camera in rig))


def _of_sign(text: str, remedy: str, cameras: tuple[str, ...]) -> Mistake:
    return Mistake("poses", text, remedy, cameras, share_left=_MAX_SHARE_LEFT_SIGN)


def _of_image(kind: str, text: str, name: str) -> Mistake:
    """One camera's image that is reversed."""
    turned = f'Write rotation = 180 into [[camera]] {name}; its keypoints are then frame = "video".'
    remedy = _MIRRORED.format(f"{name} was") if kind == "mirrored" else turned
    return Mistake(kind, f"{name}'s image {text}", remedy, (name,))


def _orders(cameras: int) -> Iterator[tuple[int, ...]]:
    """Orders of the cameras but their own: exchanges of two first, then all others of a few."""
    for a, b in combinations(range(cameras), 2):
        exchanged = list(range(cameras))
        exchanged[a], exchanged[b] = b, a
        yield tuple(exchanged)
    if cameras <= _MAX_CAMERAS_PERMUTED:
        for order in permutations(range(cameras)):
            if sum(o != c for c, o in enumerate(order)) > 2:
                yield order


def _signs() -> Iterator[tuple[str, Callable[[NDArray], NDArray]]]:
    """Poses with one number of the translation, or of the place in the world, of the other sign."""
    for axis, name in enumerate("xyz"):
        yield f"the {name} of the translation has the wrong sign", partial(_negated, axis=axis)
        inverted = f"the {name} of the place in the world has the wrong sign"
        yield inverted, partial(_negated, axis=axis, in_world=True)


def _negated(T_camera_world: NDArray, axis: int, in_world: bool = False) -> NDArray:
    """A pose whose translation, or place in the world, has one number of the other sign."""
    out = np.array(inverse(T_camera_world) if in_world else T_camera_world)
    out[axis, 3] *= -1.0
    return inverse(out) if in_world else out


def _posed(camera: Camera, change: Callable[[NDArray], NDArray]) -> Camera:
    return camera.with_pose(change(camera.T_camera_world))


def _zoomed(camera: Camera, factor: float, whole: bool) -> Camera:
    """A camera whose focal lengths, and with `whole` the principal point, are so many times as large."""
    matrix = np.array(camera.matrix)
    matrix[:2, :2] *= factor
    matrix[:2, 2] *= factor if whole else 1.0
    return replace(camera, matrix=matrix)


def _reversed(camera: Camera, uv: NDArray, axes: Sequence[int]) -> NDArray:
    """Pixels (..., 2) with some axes of the image reversed."""
    out = uv.copy()
    for axis in axes:
        out[..., axis] = camera.size[axis] - 1 - out[..., axis]
    return out


def _times(factor: float) -> str:
    return {2.0: "twice", 0.5: "half"}.get(round(factor, 3), f"{factor:.2g} times")


def _focal_remedy(who: str) -> str:
    return f"Calibrate the lenses of {who} at the videos' image size, or correct fx and fy in the calibration."


_MIRRORED = (
    "If {} recorded mirrored, mirror the video back (ffmpeg -i IN -vf hflip OUT) and detect anew; if the calibration "
    "comes from a left-handed world (Unity, Unreal), export it right-handed."
)
