"""Find gross mistakes: swapped cameras, inverted poses, wrong signs, mirrored images, focal lengths of another size.

Each one is corrected on a few hundred points, and reported if the cameras then agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Edit, Finding, listed
from kinefit.fitting.multiview.views import KeypointViews, disagreement_share, points_of_others, sample, share_against
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.rigs.diagnostics.cameras import FOREIGN_ERROR, odd_camera

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
_SIZE_RATIOS = (2.0, 1.5, 4 / 3, 3.0, 4.0)  # of common videos, 360 to 2160 lines
_MIRRORED = (
    "If {} recorded mirrored, mirror the video back (ffmpeg -i IN -vf hflip OUT) and detect again. If the calibration "
    "comes from a left-handed world (Unity, Unreal), export it right-handed."
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
    sides : whether the detector took left for right in it.
    before, after : mean error of all views, before and after the correction, as a share of the limit.
    share_left : largest ratio of the error after the correction to that before.
    edits : lines of the take that mend it.
    over_pose : largest ratio of one camera's error after the correction to that at its best pose.
    """

    kind: str
    text: str
    remedy: str
    cameras: tuple[str, ...] = ()
    sides: bool = False
    before: float = 0.0
    after: float = 0.0
    share_left: float = _MAX_RATIO
    edits: tuple[Edit, ...] = ()
    over_pose: float = _MAX_FREE_POSE_RATIO

    def explains(self, *, lenient: bool) -> bool:
        """Whether the cameras agree after the correction."""
        likely = lenient and self.after <= _MAX_ERROR_LENIENT and self.after <= _MAX_RATIO_LENIENT * self.before
        return likely or self.after < self.share_left * self.before

    def finding(self, names: Sequence[str], limit: float) -> Finding:
        """The finding; `names` of all cameras, `limit` [px] of the shares."""
        word = "Certain" if self.explains(lenient=False) else "Likely"
        confidence = f"{word}: with this corrected, the cameras' mean error falls from {100 * self.before:.0f} % to "
        confidence += f"{100 * self.after:.0f} % of the {limit:.0f} px within which two views agree."
        text = self.text if self.text.startswith(tuple(names)) else self.text[:1].upper() + self.text[1:]
        return Finding("fault", self.kind, f"{text}.", self.cameras, confidence, self.remedy, self.edits)


Trial = tuple[Mistake, Callable[[Camera, NDArray], tuple[Camera, NDArray]]]
"""A candidate mistake, and its correction: of a camera, and of its pixels (N, 2)."""


def mistake_findings(views: KeypointViews, take_file: str = "the take", *, lenient: bool = False) -> list[Finding]:
    """Find the gross mistake that explains the disagreement of the cameras, if there is one.

    Parameters
    ----------
    views : KeypointViews
    take_file : name, for remedies.
    lenient : bool, whether a mistake is known to exist, so that a smaller improvement suffices.
    """
    uv = sample(views)
    before, mistake = disagreement_share(views.rig, uv), None
    if before >= _MIN_ERROR_SHARE:
        mistake = _best(_trials(views.rig, uv, take_file), before, lenient=lenient)
    mistake = mistake or _of_one_camera(views, lenient)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


def focal_findings(views: KeypointViews) -> list[Finding]:
    """Find focal lengths of another image size, after the person's size was found implausible.

    None of two cameras: a wrong pose of one of them looks the same.
    """
    uv = sample(views)
    trials = _of_all(_focal_lengths() if len(views.rig) > 2 else (), views.rig, uv)
    mistake = _best(trials, disagreement_share(views.rig, uv), lenient=True)
    return [mistake.finding(views.rig.names, views.limit)] if mistake else []


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
    exchanged = sample(replace(views, uv=views.uv[:, views.partner]))
    for c, camera in enumerate(views.rig if len(views.rig) > 2 else ()):
        x_world, uv = points_of_others(views, c), sample(views)[:, c]
        before = share_against(x_world, camera, uv, views.limit)
        if before < FOREIGN_ERROR or (odd is not None and c != odd):
            continue
        for mistake, change in (*_reversals(camera.name), *_signs(camera.name), *_focal_lengths(camera.name)):
            other, seen = change(camera, exchanged[:, c] if mistake.sides else uv)
            tried = replace(mistake, before=before, after=share_against(x_world, other, seen, views.limit))
            explains = tried.explains(lenient=False) or (c == odd and tried.after <= _MAX_RATIO_LENIENT * before)
            if not explains or (best is not None and tried.after >= 0.9 * best.after):
                continue
            if tried.after <= mistake.over_pose * _share_of_free_pose(camera, uv, x_world, views.limit):
                best = tried
    return best


def _share_of_free_pose(camera: Camera, uv: NDArray, x_world: NDArray, limit: float) -> float:
    """Error of one camera's views of points (N, 3) [m] at its best pose, as a share 0..1 (see `share_against`)."""
    rays = camera.ray(uv) @ camera.T_camera_world[:3, :3].T
    use = np.isfinite(x_world).all(axis=1) & np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    if use.sum() < _MIN_POSE_POINTS:
        return np.inf
    found, rotation, translation, _ = cv2.solvePnPRansac(
        x_world[use], rays[use, :2] / rays[use, 2:], np.eye(3), np.zeros(4),
        reprojectionError=float(limit / camera.matrix[0, 0]),
    )  # fmt: skip
    if not found:
        return np.inf
    pose = se3.transform(se3.exp_so3(rotation.ravel()), translation.ravel())
    return share_against(x_world, camera.with_pose(pose), uv, limit)


def _trials(rig: Rig, uv: NDArray, take_file: str) -> Iterator[tuple[Mistake, Rig, NDArray]]:
    """Candidate mistakes of the rig, the most probable first, each with the corrected rig and pixels (N, C, 2)."""
    for order in _orders(len(rig)):
        moved = {rig.names[c]: rig.names[o] for c, o in enumerate(order) if o != c}
        renamed = ", ".join(f"{old} to {new}" for old, new in moved.items())
        remedy = f"In [[camera]] and [[keypoints]] of {take_file}, rename {renamed}. Do not rename the calibration's."
        edits = tuple(
            Edit(table, key, f'"{new}"', old)
            for old, new in moved.items() for table, key in (("camera", "name"), ("keypoints", "camera"))
        )  # fmt: skip
        cameras = Rig(tuple(replace(rig.cameras[o], name=rig.names[c]) for c, o in enumerate(order)))
        yield Mistake("swapped", f"{listed(moved)} are swapped", remedy, tuple(moved), edits=edits), cameras, uv
    several = len(rig) > 2  # two cameras nearly agree whatever they are
    yield from _of_all((*_conventions(), *(_signs() if several else ()), *_mirrored()), rig, uv)
    for kinds in zip(*(_reversals(name) for name in rig.names), strict=True):
        for c, (mistake, change) in enumerate(kinds):
            if not mistake.sides:
                seen = uv.copy()
                _, seen[:, c] = change(rig.cameras[c], uv[:, c])
                yield mistake, rig, seen
    yield from _of_all(_focal_lengths() if several else (), rig, uv)


def _of_all(trials: Iterable[Trial], rig: Rig, uv: NDArray) -> Iterator[tuple[Mistake, Rig, NDArray]]:
    """Trials with all cameras changed."""
    for mistake, change in trials:
        cameras, seen = zip(*(change(camera, uv[:, c]) for c, camera in enumerate(rig)), strict=True)
        yield mistake, Rig(cameras), np.stack(seen, axis=1)


def _conventions() -> Iterator[Trial]:
    """Poses in another convention than OpenCV's."""
    remedy = "Export the calibration with poses from world to camera, x right, y down, z ahead (OpenCV's convention)."
    changes: dict[str, Callable[[NDArray], NDArray]] = {
        "the poses are camera to world instead of world to camera": se3.inverse,
        "the camera axes are those of computer graphics (y up, z backward), not y down, z ahead":
            _FROM_OPENGL.__matmul__,
        "the poses are camera to world with the axes of computer graphics (y up, z backward)":
            lambda T: _FROM_OPENGL @ se3.inverse(T),
    }  # fmt: skip
    for text, change in changes.items():
        yield Mistake("poses", text, remedy), partial(_posed, change=change)


def _mirrored() -> Iterator[Trial]:
    """All images mirrored, or a left-handed world."""
    for axis, way in ((1, "upside down (or the world is left-handed)"), (0, "left to right (or the world is)")):
        mistake = Mistake("mirrored", f"all images are mirrored {way}", _MIRRORED.format("the images were"))
        yield mistake, partial(_reversed, axes=(axis,))


def _reversals(name: str) -> tuple[Trial, ...]:
    """Images of one camera mirrored, where a detector took left for right or not, or upside down."""
    remedy = _MIRRORED.format(f"{name} was")
    mirrored = Mistake("mirrored", f"{name}'s image is mirrored left to right", remedy, (name,))
    remedy = f'Write rotation = 180 into [[camera]] {name}, and frame = "video" into its [[keypoints]].'
    edits = Edit("camera", "rotation", "180", name), Edit("keypoints", "frame", '"video"', name)
    turned = Mistake("turned", f"{name}'s image stands upside down", remedy, (name,), edits=edits)
    flip = partial(_reversed, axes=(0,))
    return (replace(mirrored, sides=True), flip), (mirrored, flip), (turned, partial(_reversed, axes=(0, 1)))


def _signs(name: str = "") -> Iterator[Trial]:
    """The sign of one coordinate of the translation, or of the position in the world, of a camera or of all."""
    who, remedy = "in all cameras", "Correct the signs in the calibration, or calibrate again."
    if name:
        who, remedy = f"{name}:", f"Correct the sign in the calibration of {name}, or calibrate it again."
    for axis, in_world in product(range(3), (False, True)):
        what = f"the {'xyz'[axis]} of the {'position in the world' if in_world else 'translation'}"
        over_pose = _MAX_FREE_POSE_RATIO_IN_WORLD if in_world else _MAX_FREE_POSE_RATIO
        yield Mistake(
            "poses", f"{who} {what} has the wrong sign", remedy, (name,) if name else (), share_left=_MAX_RATIO_SIGN,
            over_pose=over_pose,
        ), partial(_posed, change=partial(_negated, axis=axis, in_world=in_world))  # fmt: skip


def _focal_lengths(name: str = "") -> Iterator[Trial]:
    """Focal lengths of another image size, with or without the principal point, of a camera or of all."""
    cameras: tuple[str, ...] = ()
    text = "the focal lengths of all cameras are about {} those that fit the keypoints"
    if name:
        text, cameras = f"{name}: its focal length is about {{}} the one that fits the keypoints", (name,)
    remedy = f"Calibrate the lenses of {name or 'the cameras'} at the videos' image size, or correct fx and fy in the "
    for factor, whole in product((*_SIZE_RATIOS, *(1 / f for f in _SIZE_RATIOS)), (False, True)):
        times = {2.0: "twice", 0.5: "half"}.get(round(1 / factor, 3), f"{1 / factor:.2g} times")
        mistake = Mistake("focal", text.format(times), f"{remedy}calibration.", cameras)
        yield mistake, partial(_zoomed, factor=factor, whole=whole)


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


def _negated(T_camera_world: NDArray, axis: int, in_world: bool) -> NDArray:
    """A pose (4, 4) with the sign of one coordinate of its translation, or position in the world, changed."""
    out = np.array(se3.inverse(T_camera_world) if in_world else T_camera_world)
    out[axis, 3] *= -1.0
    return se3.inverse(out) if in_world else out


def _posed(camera: Camera, uv: NDArray, change: Callable[[NDArray], NDArray]) -> tuple[Camera, NDArray]:
    return camera.with_pose(change(camera.T_camera_world)), uv


def _zoomed(camera: Camera, uv: NDArray, factor: float, whole: bool) -> tuple[Camera, NDArray]:
    """A camera with its focal lengths, and with `whole` its principal point, multiplied by a factor."""
    matrix = np.array(camera.matrix)
    matrix[:2, :2] *= factor
    matrix[:2, 2] *= factor if whole else 1.0
    return replace(camera, matrix=matrix), uv


def _reversed(camera: Camera, uv: NDArray, axes: Sequence[int]) -> tuple[Camera, NDArray]:
    """Pixels (N, 2) [px] with some axes of the image reversed."""
    out = uv.copy()
    for axis in axes:
        out[..., axis] = camera.size[axis] - 1 - out[..., axis]
    return camera, out
