"""Find gross mistakes: swapped cameras, inverted poses, wrong signs, mirrored images, focal lengths of another size.

Each one is corrected on a few hundred points, and reported if the cameras then agree.
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
    FOREIGN_ERROR,
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

_MIN_ERROR_SHARE = 0.25  # mean error of all views, as a share of the limit: less is no gross mistake
_MAX_RATIO = 0.5  # of the error after the correction to the error before
_MAX_RATIO_SIGN = 0.4  # the same, if one sign is changed: a small motion has a similar effect
_MAX_RATIO_LENIENT = 0.7  # the same, if other evidence shows that there is a mistake
_MAX_ERROR_LENIENT = 0.35  # as a share of the limit, in that case: real recordings without mistakes have 0.06 to 0.31
_MAX_FREE_POSE_RATIO = 1.65
"""Error of one camera after the correction, to the error at its best pose: 0.8 to 1.6 for a sign or a focal length, 1.7
to 2.6 for a rotated camera that resembles one."""
_MAX_FREE_POSE_RATIO_IN_WORLD = 1.25  # the same for a sign of the position in the world: rotated cameras 1.3 and more
_MIN_POSE_POINTS = 12  # twice the unknowns
_MAX_PERMUTED_CAMERAS = 4  # of which all orders are tried; with more cameras, swaps of two
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from x right, y up, z back to x right, y down, z ahead
_REVERSALS = (  # kind, text, axes, and whether the detector swapped left and right in it
    ("mirrored", "is mirrored left to right", (0,), True), ("mirrored", "is mirrored left to right", (0,), False),
    ("turned", "stands upside down", (0, 1), False),
)  # fmt: skip
_SIZE_RATIOS = (2.0, 1.5, 4 / 3, 3.0, 4.0)  # of common videos, 360 to 2160 lines
_FOCAL_TRIALS = tuple(  # factor, whether of the principal point, too
    product((*_SIZE_RATIOS, *(1 / f for f in _SIZE_RATIOS)), (False, True))
)


@dataclass(frozen=True)
class Mistake:
    """A gross mistake whose correction makes the cameras agree.

    Parameters
    ----------
    kind : "swapped", "poses", "mirrored", "turned" or "focal"
    text : what is wrong, without a full stop.
    remedy : what to do.
    cameras : affected cameras; empty for all.
    before, after : mean error of all views, before and after the correction, as a share of the limit.
    share_left : largest ratio of the error after the correction to that before.
    over_pose : largest ratio of one camera's error after the correction to that at its best pose.
    """

    kind: str
    text: str
    remedy: str
    cameras: tuple[str, ...]
    before: float = 0.0
    after: float = 0.0
    share_left: float = _MAX_RATIO
    over_pose: float = _MAX_FREE_POSE_RATIO

    def explains(self, *, lenient: bool) -> bool:
        """Whether the cameras agree after the correction."""
        likely = lenient and self.after <= _MAX_ERROR_LENIENT and self.after <= _MAX_RATIO_LENIENT * self.before
        return likely or self.after < self.share_left * self.before

    def finding(self, names: Sequence[str], limit: float) -> Finding:
        """The finding; `names` of all cameras, `limit` [px] of the shares."""
        word = "Certain" if self.explains(lenient=False) else "Likely"
        confidence = (
            f"{word}: with this corrected, the cameras' mean error falls from {100 * self.before:.0f} % to "
            f"{100 * self.after:.0f} % of the {limit:.0f} px within which two views agree."
        )
        text = self.text if self.text.startswith(tuple(names)) else self.text[:1].upper() + self.text[1:]
        return Finding("fault", self.kind, f"{text}.", self.cameras, confidence, self.remedy)


def mistake_findings(views: KeypointViews, take_file: str = "the take", *, lenient: bool = False) -> list[Finding]:
    """Find the gross mistake that explains the disagreement of the cameras, if there is one.

    Parameters
    ----------
    views : KeypointViews
    take_file : name, for remedies.
    lenient : bool, whether a mistake is known to exist, so that a smaller improvement suffices.
    """
    mistake = _of_the_rig(views, take_file, lenient) or _of_one_camera(views, lenient)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


def focal_findings(views: KeypointViews) -> list[Finding]:
    """Find focal lengths of another image size, after the person's size was found implausible."""
    uv = sample(views)
    trials = ((mistake, rig, uv) for mistake, rig in _focal_lengths(views.rig))
    mistake = _best(trials, disagreement_share(views.rig, uv), lenient=True)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


def _of_the_rig(views: KeypointViews, take_file: str, lenient: bool) -> Mistake | None:
    """The gross mistake of the whole rig whose correction makes all cameras agree."""
    uv = sample(views)
    before = disagreement_share(views.rig, uv)
    return None if before < _MIN_ERROR_SHARE else _best(_trials(views.rig, uv, take_file), before, lenient=lenient)


def _best(trials: Iterator[tuple[Mistake, Rig, NDArray]], before: float, *, lenient: bool) -> Mistake | None:
    """The trial with the smallest error, if the cameras then agree; the first of nearly equal ones."""
    best: Mistake | None = None
    for mistake, rig, uv in trials:
        tried = replace(mistake, before=before, after=disagreement_share(rig, uv))
        if tried.explains(lenient=lenient) and (best is None or tried.after < 0.9 * best.after):
            best = tried
    return best


def _of_one_camera(views: KeypointViews, lenient: bool) -> Mistake | None:
    """A mistake of one camera whose correction makes it agree with the others."""
    best: Mistake | None = None
    odd = odd_camera(views) if lenient else None
    for c, camera in enumerate(views.rig if len(views.rig) > 2 else ()):
        x_world = points_of_others(views, c)
        before = share_against(x_world, camera, sample(views)[:, c], views.limit)
        if before < FOREIGN_ERROR or (odd is not None and c != odd):
            continue
        for mistake, other, uv in _trials_of_one(views, c):
            tried = replace(mistake, before=before, after=share_against(x_world, other, uv, views.limit))
            explains = tried.explains(lenient=False) or (c == odd and tried.after <= _MAX_RATIO_LENIENT * before)
            if not explains or (best is not None and tried.after >= 0.9 * best.after):
                continue
            if tried.after <= mistake.over_pose * _share_of_free_pose(views, c, x_world):
                best = tried
    return best


def _share_of_free_pose(views: KeypointViews, c: int, x_world: NDArray) -> float:
    """Error of one camera's views of points (N, 3) [m] at its best pose, as a share 0..1 (see `share_against`)."""
    camera, uv = views.rig.cameras[c], sample(views)[:, c]
    rays = camera.ray(uv) @ camera.T_camera_world[:3, :3].T
    use = np.isfinite(x_world).all(axis=1) & np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    if use.sum() < _MIN_POSE_POINTS:
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
    """Candidate mistakes of one camera, each with the corrected camera and pixels (N, 2) of `sample`."""
    camera, uv = views.rig.cameras[c], sample(views)[:, c]
    name = camera.name
    for kind, text, axes, sides in _REVERSALS:
        seen = sample(replace(views, uv=views.uv[:, views.partner]))[:, c] if sides else uv
        yield _of_image(kind, text, name), camera, _reversed(camera, seen, axes)
    for text, change in _signs():
        remedy = f"Correct the sign in the calibration of {name}, or calibrate it again."
        mistake = _of_sign(f"{name}: {text}", remedy, (name,))
        if "world" in text:
            mistake = replace(mistake, over_pose=_MAX_FREE_POSE_RATIO_IN_WORLD)
        yield mistake, _posed(camera, change), uv
    for factor, whole in _FOCAL_TRIALS:
        text = f"{name}: its focal length is about {_times(1 / factor)} the one that fits the keypoints"
        yield Mistake("focal", text, _focal_remedy(name), (name,)), _zoomed(camera, factor, whole), uv


def _trials(rig: Rig, uv: NDArray, take_file: str) -> Iterator[tuple[Mistake, Rig, NDArray]]:
    """Candidate mistakes of the rig, the most probable first, each with the corrected rig and pixels (N, C, 2)."""
    for order in _orders(len(rig)):
        moved = [c for c in range(len(rig)) if order[c] != c]
        names = tuple(rig.names[c] for c in moved)
        renamed = ", ".join(f"{rig.names[c]} to {rig.names[order[c]]}" for c in moved)
        remedy = f"In [[camera]] and [[keypoints]] of {take_file}, rename {renamed}. Do not rename the calibration's."
        cameras = Rig(tuple(replace(rig.cameras[o], name=rig.names[c]) for c, o in enumerate(order)))
        yield Mistake("swapped", f"{listed(names)} are swapped", remedy, names), cameras, uv
    poses: dict[str, Callable[[NDArray], NDArray]] = {
        "the poses are camera to world instead of world to camera": inverse,
        "the camera axes are those of computer graphics (y up, z backward), not y down, z ahead":
            _FROM_OPENGL.__matmul__,
        "the poses are camera to world with the axes of computer graphics (y up, z backward)":
            lambda T: _FROM_OPENGL @ inverse(T),
    }  # fmt: skip
    remedy = "Export the calibration with poses from world to camera, x right, y down, z ahead (OpenCV's convention)."
    for text, change in poses.items():
        yield Mistake("poses", text, remedy, ()), Rig(tuple(_posed(c, change) for c in rig)), uv
    for text, change in _signs() if len(rig) > 2 else ():  # two cameras nearly agree whatever they are
        mistake = _of_sign(f"in all cameras {text}", "Correct the signs in the calibration, or calibrate again.", ())
        yield mistake, Rig(tuple(_posed(c, change) for c in rig)), uv
    for axis, way in ((1, "upside down (or the world is left-handed)"), (0, "left to right (or the world is)")):
        mistake = Mistake("mirrored", f"all images are mirrored {way}", _MIRRORED.format("the images were"), ())
        yield mistake, rig, np.stack([_reversed(camera, uv[:, c], (axis,)) for c, camera in enumerate(rig)], axis=1)
    for (kind, text, axes, sides), (c, camera) in product(_REVERSALS, enumerate(rig)):
        if not sides:
            seen = uv.copy()
            seen[:, c] = _reversed(camera, uv[:, c], axes)
            yield _of_image(kind, text, camera.name), rig, seen
    for mistake, zoomed in _focal_lengths(rig) if len(rig) > 2 else ():
        yield mistake, zoomed, uv


def _focal_lengths(rig: Rig) -> Iterator[tuple[Mistake, Rig]]:
    """Candidate focal lengths of another image size for all cameras, with or without the principal points."""
    for factor, whole in _FOCAL_TRIALS:
        text = f"the focal lengths of all cameras are about {_times(1 / factor)} those that fit the keypoints"
        mistake = Mistake("focal", text, _focal_remedy("the cameras"), ())
        yield mistake, Rig(tuple(_zoomed(camera, factor, whole) for camera in rig))


def _of_sign(text: str, remedy: str, cameras: tuple[str, ...]) -> Mistake:
    return Mistake("poses", text, remedy, cameras, share_left=_MAX_RATIO_SIGN)


def _of_image(kind: str, text: str, name: str) -> Mistake:
    """Mistake of one camera with a reversed image."""
    turned = f'Write rotation = 180 into [[camera]] {name}, and frame = "video" into its [[keypoints]].'
    remedy = _MIRRORED.format(f"{name} was") if kind == "mirrored" else turned
    return Mistake(kind, f"{name}'s image {text}", remedy, (name,))


def _orders(cameras: int) -> Iterator[tuple[int, ...]]:
    """Permutations of the cameras without the identity: swaps of two first, then all others for few cameras."""
    for a, b in combinations(range(cameras), 2):
        exchanged = list(range(cameras))
        exchanged[a], exchanged[b] = b, a
        yield tuple(exchanged)
    if cameras <= _MAX_PERMUTED_CAMERAS:
        for order in permutations(range(cameras)):
            if sum(o != c for c, o in enumerate(order)) > 2:
                yield order


def _signs() -> Iterator[tuple[str, Callable[[NDArray], NDArray]]]:
    """Changes of the sign of one coordinate of the translation, or of the position in the world."""
    for axis, name in enumerate("xyz"):
        yield f"the {name} of the translation has the wrong sign", partial(_negated, axis=axis)
        inverted = f"the {name} of the position in the world has the wrong sign"
        yield inverted, partial(_negated, axis=axis, in_world=True)


def _negated(T_camera_world: NDArray, axis: int, in_world: bool = False) -> NDArray:
    """A pose (4, 4) with the sign of one coordinate of its translation, or position in the world, changed."""
    out = np.array(inverse(T_camera_world) if in_world else T_camera_world)
    out[axis, 3] *= -1.0
    return inverse(out) if in_world else out


def _posed(camera: Camera, change: Callable[[NDArray], NDArray]) -> Camera:
    return camera.with_pose(change(camera.T_camera_world))


def _zoomed(camera: Camera, factor: float, whole: bool) -> Camera:
    """A camera with its focal lengths, and with `whole` its principal point, multiplied by a factor."""
    matrix = np.array(camera.matrix)
    matrix[:2, :2] *= factor
    matrix[:2, 2] *= factor if whole else 1.0
    return replace(camera, matrix=matrix)


def _reversed(camera: Camera, uv: NDArray, axes: Sequence[int]) -> NDArray:
    """Pixels (N, 2) [px] with some axes of the image reversed; any leading axes."""
    out = uv.copy()
    for axis in axes:
        out[..., axis] = camera.size[axis] - 1 - out[..., axis]
    return out


def _times(factor: float) -> str:
    return {2.0: "twice", 0.5: "half"}.get(round(factor, 3), f"{factor:.2g} times")


def _focal_remedy(who: str) -> str:
    return f"Calibrate the lenses of {who} at the videos' image size, or correct fx and fy in the calibration."


_MIRRORED = (
    "If {} recorded mirrored, mirror the video back (ffmpeg -i IN -vf hflip OUT) and detect again. If the calibration "
    "comes from a left-handed world (Unity, Unreal), export it right-handed."
)
