"""Guess from images and keypoints: black bars, the image frame of keypoints, the vertical axis, the unit of length."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit._files import LENGTHS
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import KinefitError, ObservationError
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import Keypoints
from kinefit.readers.guess.draft import Draft, Value
from kinefit.readers.guess.files import STATIC, KeypointFile
from kinefit.readers.guess.names import Trial, camera_number, common_words, trials
from kinefit.readers.landmarks.keypoint_sets import HAND_POINTS, OPENPOSE_HANDS, SET_OF_COUNT, SETS_WITH_HANDS
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.plugins import KEYPOINTS
from kinefit.readers.take.cameras import turned_frame
from kinefit.readers.videos.video import Video

Size = tuple[int, int]

_MAX_BAR_LEVEL = 32  # of 255: three quarters of a bar's pixels are darker; compression smears edges into bars
_MAX_FRAMES = 60  # of the keypoints, spread over the recording
_MIN_CONFIDENCE = 0.3
_MAX_MISS = 0.03  # share of the image diagonal within which two cameras agree on a point
_MAX_ASPECT_ERROR = 0.002
_MIN_OUTSIDE_SHARE = 0.005  # of points outside of an image: more are no errors of a detector
_MAX_RESIDUAL_RATIO = 0.8  # of two hypotheses: a detector's noise and a calibration's bias cause no larger difference
_OFFSET_ROUNDS = 2  # after which a camera's offset changes by a tenth of a pixel
_BONES = {  # [m] in a person of 1.75 m (Winter 2009, table 4.1: shares of the stature)
    ("shoulder", "elbow"): 0.186 * 1.75, ("elbow", "wrist"): 0.146 * 1.75, ("hip", "knee"): 0.245 * 1.75,
    ("knee", "ankle"): 0.246 * 1.75, ("shoulder", "hip"): 0.288 * 1.75,
}  # fmt: skip
_UNITS = {unit: 1.0 / LENGTHS[unit] for unit in ("m", "dm", "inch", "cm", "mm")}
_MAX_SIZE_RATIO = 1.45  # people differ by 1.25 in size; detectors and partly occluded bones add to it


def is_turned(calibrated: Size, size: Size) -> bool:
    """Whether one of two image sizes is portrait and the other landscape."""
    return (size[0] - size[1]) * (calibrated[0] - calibrated[1]) < 0


def guess_turn(rig: Rig, records: Mapping[str, Keypoints], sizes: Mapping[str, Size]) -> Value:
    """Clockwise rotation [deg] of videos in portrait whose calibration is in landscape, or the reverse: 90 or 270.

    The rays of keypoints intersect only after the right rotation. Without keypoints, the rotation is chosen so that
    people stand upright in a world whose vertical is one of its positive axes.

    Parameters
    ----------
    records : {camera: Keypoints} as the files have them.
    sizes : {camera: (width, height) [px]} of all videos.
    """
    turned = [name for name, size in sizes.items() if is_turned(rig[name].size, size)]
    misses, seen = {}, [name for name in turned if name in records]
    for degrees in (90, 270) if seen and len(records) > 1 else ():
        images = {n: turned_frame(rig[n].size, sizes[n], degrees, "scaled") for n in seen}
        x, residual = meet(rig, records, images)
        found = np.isfinite(x).all(-1).sum()
        misses[degrees] = _median(residual) / found if found else np.inf
    if misses and min(misses.values()) < _MAX_RESIDUAL_RATIO * max(misses.values()):
        best = min(misses, key=lambda degrees: misses[degrees])
        return Value(best, "likely", f"the keypoints of the cameras then agree; turned by {360 - best} they do not")
    for degrees in (90, 270):
        axis, angle = nearest_axis(up_of_cameras(rig, dict.fromkeys(turned, degrees)))
        if not axis.startswith("-") and angle < 30:
            return Value(degrees, "guess", f"people then stand upright, with {axis} up; otherwise {360 - degrees}")
    return Value(90, "guess", "clockwise or counterclockwise: try 90, then 270")


def picture(calibrated: Size, video: Video, turn: Value) -> dict[str, Value]:
    """Relation of a video's image to the calibration's: `image` and `rotation` of a `[[camera]]`.

    Parameters
    ----------
    calibrated : (width, height) [px]
    video : Video
    turn : of `guess_turn`, for a rotated video.
    """
    size, out = video.size, {}
    sizes = f"the video has {size[0]}x{size[1]} px, the calibration {calibrated[0]}x{calibrated[1]}"
    turned = calibrated
    if is_turned(calibrated, size):
        turned = calibrated[::-1]
        out["rotation"] = Value(turn.value, turn.sure, f"{sizes}; {turn.why}")
    if size == turned:
        return out
    if abs(size[0] * turned[1] / (size[1] * turned[0]) - 1) < _MAX_ASPECT_ERROR:
        return out | {"image": Value("scaled", "sure", f"{sizes}: the same shape")}
    bars, expected = black_bars(video), _letterbox_bars(turned, size)
    fits = np.all(np.abs(np.subtract(bars, expected)) <= np.maximum(2, 0.2 * np.asarray(expected)))
    if fits:
        return out | {"image": Value("letterboxed", "sure", f"{sizes}, and it has black bars of {max(bars)} px")}
    if max(expected) < 2:
        return out | {"image": Value("letterboxed", "likely", f"{sizes}: nearly the same shape")}
    return out | {"image": Value("scaled", "guess", f"{sizes}, without black bars; it may be cropped instead")}


def black_bars(video: Video, frames: int = 5) -> tuple[int, int]:
    """Widths [px] of the black bars at the left or right, and above or below; the smaller of both sides."""
    numbers = np.unique(np.linspace(0, len(video) - 1, frames).astype(int))
    brightest = np.max([video.read(int(i)) for i in numbers], axis=0).max(axis=2)
    columns, rows = (np.percentile(brightest, 75, axis=axis) > _MAX_BAR_LEVEL for axis in (0, 1))
    return _dark_ends(columns), _dark_ends(rows)


def _dark_ends(bright: NDArray) -> int:
    at = np.flatnonzero(bright)
    return int(min(at[0], len(bright) - 1 - at[-1])) if len(at) else 0


def _letterbox_bars(calibrated: Size, size: Size) -> tuple[int, int]:
    s = min(size[0] / calibrated[0], size[1] / calibrated[1])
    return round(0.5 * (size[0] - s * calibrated[0])), round(0.5 * (size[1] - s * calibrated[1]))


def one_person(record: Keypoints, frames: NDArray) -> NDArray:
    """(F, K, 2) [px] points of the largest confident person in some frames; NaN where not detected."""
    points, confidence = record.points[frames], record.confidence[frames]
    points = np.where((confidence > _MIN_CONFIDENCE)[..., None], points, np.nan)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # a frame without people is all NaN
        extent = np.linalg.norm(np.nanmax(points, axis=2) - np.nanmin(points, axis=2), axis=-1)
    score = np.nan_to_num(extent) * np.isfinite(points[..., 0]).sum(-1)
    return points[np.arange(len(frames)), np.argmax(score, axis=1)]


def spread_frames(count: int) -> NDArray:
    """(F,) frame numbers, spread over a recording of `count` frames."""
    return np.unique(np.linspace(0, count - 1, _MAX_FRAMES).astype(int))


def keypoint_frame(
    rig: Rig, records: Mapping[str, Keypoints], images: Mapping[str, ImageFrame], sizes: Mapping[str, Size]
) -> Value | None:
    """Whether keypoints are in pixels of the "video" or of the "calibration"; None if these are the same everywhere.

    Parameters
    ----------
    records : {camera: Keypoints} as the files have them.
    images : {camera: ImageFrame} of the cameras whose video differs from the calibration's image.
    sizes : {camera: (width, height) [px] of the video}
    """
    images = {name: image for name, image in images.items() if name in records}
    if not images:
        return None
    for name in images:
        points = records[name].points[records[name].confidence > _MIN_CONFIDENCE]
        outside = {
            frame: float(np.any((points > np.add(size, 0.5)) | (points < -1.5), axis=-1).mean()) if len(points) else 0.0
            for frame, size in (("video", sizes[name]), ("calibration", rig[name].size))
        }
        for frame, other in (("calibration", "video"), ("video", "calibration")):
            if outside[other] > _MIN_OUTSIDE_SHARE > outside[frame]:
                share = f"{100 * outside[other]:.1f} % of the points of {name} lie outside the {other}'s image"
                return Value(frame, "sure" if outside[other] > 10 * _MIN_OUTSIDE_SHARE else "likely", share)
    for rounds in (0, _OFFSET_ROUNDS):
        medians = {
            frame: _median(meet(rig, records, images if frame == "video" else {}, offset_rounds=rounds)[1])
            for frame in ("video", "calibration")
        }
        if not np.isfinite(list(medians.values())).all():
            return Value("video", "guess", "detectors run on the video; too few detections to check this")
        best, other = sorted(medians, key=lambda name: medians[name])
        if not rounds and medians[best] < _MAX_RESIDUAL_RATIO * medians[other]:
            why = f"the cameras agree to {medians[best]:.1f} px; in the {other}'s image, to {medians[other]:.1f} px"
            return Value(best, "likely", why)
    why = f"{medians[best]:.2f} px; in the {other}'s image, to {medians[other]:.2f} px"
    return Value(best, "guess", f"a small difference: without each camera's bias the cameras agree to {why}")


def _median(residual: NDArray) -> float:
    """Median of the finite ones; NaN without one."""
    finite = residual[np.isfinite(residual)]
    return float(np.median(finite)) if len(finite) else np.nan


def meet(
    rig: Rig, records: Mapping[str, Keypoints], images: Mapping[str, ImageFrame] | None = None, offset_rounds: int = 0
) -> tuple[NDArray, NDArray]:
    """Triangulate the keypoints of some frames.

    Parameters
    ----------
    images : {camera: ImageFrame} of the cameras whose keypoints are not in the calibration's image.
    offset_rounds : int
        Times that each camera's median error, a bias of the calibration, is subtracted from its points.

    Returns
    -------
    x_world : (F, K, 3) [m], NaN where no two cameras agree; residual_px : (F, K, C) [px].
    """
    rig = rig.select(tuple(records))
    frames = spread_frames(min(len(record) for record in records.values()))
    views = []
    for name, record in records.items():
        image, seen = (images or {}).get(name), one_person(record, frames)
        views.append(image.to_calibration(seen) if image else seen)
    points = np.stack(views, axis=2)  # (F, K, C, 2)
    limit = _MAX_MISS * max(float(np.hypot(*camera.size)) for camera in rig)
    flat = points.reshape(-1, *points.shape[2:])
    x, inliers, residual = triangulate_robust(rig, flat, max_residual_px=limit)
    for _ in range(offset_rounds if inliers.any(0).all() else 0):
        errors = flat - np.stack([camera.project(x) for camera in rig], axis=1)
        flat = flat - np.nanmedian(np.where(inliers[..., None], errors, np.nan), axis=0)
        x, inliers, residual = triangulate_robust(rig, flat, max_residual_px=limit)
    residual = np.where(inliers, residual, np.nan)
    return x.reshape(*points.shape[:2], 3), residual.reshape(points.shape[:3])


def guess_unit(x: NDArray, names: Sequence[str]) -> Value:
    """Unit of length of the calibration, from the size of a person with points (F, K, 3) in that unit."""
    ratios = []
    for (a, b), length in _BONES.items():
        for side in ("left", "right"):
            i, j = _point(names, side, a), _point(names, side, b)
            if i is not None and j is not None:
                ratios += (np.linalg.norm(x[:, i] - x[:, j], axis=-1) / length).tolist()
    seen = np.array(ratios)[np.isfinite(ratios)]
    if len(seen) < 20:
        return Value(None, "open", "too few points meet in space to estimate the person's size")
    ratio = float(np.median(seen))
    unit = min(_UNITS, key=lambda u: abs(np.log(ratio / _UNITS[u])))
    if abs(np.log(ratio / _UNITS[unit])) < np.log(_MAX_SIZE_RATIO):
        height = 1.75 * ratio / _UNITS[unit]
        return Value(unit, "likely", f"by the length of the limbs the person is {height:.2f} m tall")
    return Value(None, "open", f"in metres the person would be {1.75 * ratio:.3g} m tall: no known unit fits")


def up_of_person(x: NDArray, names: Sequence[str]) -> NDArray | None:
    """(3,) unit direction from hips to shoulders, or ankles to hips, in points (F, K, 3); None if unobserved."""
    for low, high in (("hip", "shoulder"), ("ankle", "hip"), ("hip", "ear"), ("elbow", "shoulder")):
        at = {
            (side, joint): _point(names, side, joint) for side in ("left", "right") for joint in (low, high)
        }
        if None in at.values():
            continue
        ways = sum(x[:, at[side, high]] - x[:, at[side, low]] for side in ("left", "right"))
        ways = ways[np.isfinite(ways).all(-1)]  # type: ignore[index]
        if len(ways) >= 3:
            way = np.median(ways / np.linalg.norm(ways, axis=1, keepdims=True), axis=0)
            return way / np.linalg.norm(way)
    return None


def up_of_cameras(rig: Rig, turns: Mapping[str, int] | None = None) -> NDArray:
    """(3,) mean unit direction that points up in the cameras' images: most cameras stand upright.

    Parameters
    ----------
    turns : {camera: clockwise rotation [deg] of its video against the calibration's image}, optional
    """
    up_camera = {0: (0, -1, 0), 90: (-1, 0, 0), 180: (0, 1, 0), 270: (1, 0, 0)}
    ways = [np.array(up_camera[(turns or {}).get(c.name, 0)]) @ c.T_camera_world[:3, :3] for c in rig]
    mean = np.sum(ways, axis=0)
    return mean / (np.linalg.norm(mean) or 1.0)


def nearest_axis(way: NDArray) -> tuple[str, float]:
    """Axis of the world nearest to a unit direction (3,), and the angle to it [deg]."""
    name = max(UP_AXES, key=lambda axis: float(np.dot(UP_AXES[axis], way)))
    return name, float(np.degrees(np.arccos(np.clip(np.dot(UP_AXES[name], way), -1, 1))))


def guess_up(rig: Rig, person: NDArray | None, turns: Mapping[str, int], *, qualisys: bool) -> Value:
    """The vertical axis of the calibration's world, by its format, the person's up (3,) and the cameras."""
    cameras, tilt = nearest_axis(up_of_cameras(rig, turns))
    votes = {"the cameras stand upright": cameras}
    if person is not None:
        axis, lean = nearest_axis(person)
        votes, tilt = {"the person stands upright": axis} | votes, min(tilt, lean)
    if qualisys:
        votes = {"Qualisys' worlds are z up": "z"} | votes
    why, axis = next(iter(votes.items()))
    against = [f"{reason} would give {other}" for reason, other in votes.items() if other != axis]
    if against:
        return Value(axis, "guess", f"{why}; but {', '.join(against)}")
    leaning = f", {tilt:.0f} degrees off the axis: the world may lean" if tilt > 15 else ""
    sure = "guess" if tilt > 30 else "sure" if len(votes) > 1 and tilt < 20 else "likely"
    return Value(axis, sure, f"{' and '.join(votes)}{leaning}")


def _point(names: Sequence[str], side: str, joint: str) -> int | None:
    """Index of a joint's point in either spelling, "LHip" or "left_hip"; None if it is missing."""
    for spelled in (f"{side}_{joint}", f"{side[0].upper()}{joint.capitalize()}"):
        if spelled in names:
            return list(names).index(spelled)
    return None


Source = dict[str, KeypointFile]  # camera -> its file, of one detector

_AMBIGUOUS_COUNTS = (25, 25 + 2 * HAND_POINTS)  # points of BODY_25 and BODY_25B, without hands and with them
_STEPS_OF_POSE2SIM = ("pose-sync", "pose/", "pose-associated")  # folders: synchronised first, then with all people
_MAX_LENGTH_ERROR = 0.1  # share of the video's frames; keypoints with a larger error are of another recording


def keypoint_sources(
    draft: Draft, found: Sequence[KeypointFile], rig: Rig, frames: int, place: str
) -> list[Source]:
    """Keypoints of each detector that belong to the videos, by their number of frames (0 without videos) and place."""
    out: list[Source] = []
    for format in (name for name in KEYPOINTS.names() if any(k.format == name for k in found)):
        of = {k.path: k for k in found if k.format == format and k.points}
        for k in found:
            if k.format == format and not k.points:
                draft.note("keypoints", "open", f"{draft.name(k.path)}: no person in any frame, not used")
        if KEYPOINTS.get(format).has_all_cameras:
            numbered = [name for name in rig.names if camera_number(name) is not None]
            groups = [Trial(dict.fromkeys(numbered, path), "number", draft.name(path)) for path in of]
        else:
            groups = trials(list(of), draft.folder, rig.names)[0]
        groups = [trial for trial in groups if len(trial.files) > 1]
        counts = {trial.place: min(of[path].frames for path in trial.files.values()) for trial in groups}

        def rank(trial: Trial, counts: Mapping[str, int] = counts) -> tuple[bool, bool, int, int, int]:
            off = abs(counts[trial.place] - frames) if frames else -counts[trial.place]
            shared = -common_words(trial.place, place)
            step = next((k for k, word in enumerate(_STEPS_OF_POSE2SIM) if word in trial.place), 1)
            other = bool(frames) and off > _MAX_LENGTH_ERROR * frames
            return bool(STATIC.search(trial.place)), other, shared, step, off

        for trial in sorted(groups, key=rank)[:1]:
            if frames and abs(counts[trial.place] - frames) > _MAX_LENGTH_ERROR * frames:
                reason = f"{counts[trial.place]} frames, the videos have {frames}: another recording, not used"
                draft.note("keypoints", "likely", f"{trial.place}: {reason}")
            else:
                out.append({name: of[path] for name, path in trial.files.items()})
    return out


def read_sources(draft: Draft, sources: Sequence[Source]) -> list[dict[str, Keypoints]]:
    """Read the keypoints of every detector and camera; add a remark on each file that cannot be read."""
    out = []
    for source in sources:
        read: dict[str, Keypoints] = {}
        for name, file in source.items():
            try:
                read[name] = _read(file, name)
            except KinefitError as error:
                draft.note(f"keypoints {name}", "open", f"{draft.name(file.path)} not used: {error.problem}")
        out.append(read)
    return out


def _read(file: KeypointFile, camera: str) -> Keypoints:
    """Read the keypoints of a camera, at 1 Hz if the format states no rate."""
    if file.format == "openpose":
        if file.points not in SET_OF_COUNT:
            known = ", ".join(map(str, sorted(SET_OF_COUNT)))
            raise ObservationError(f"{file.points} points; there are sets of {known}")
        record = read_keypoints(file.path, format=file.format, camera=camera, rate=1.0)
        if record.keypoint_set == "BODY_25" and file.points > 25:
            record = read_keypoints(
                file.path, format=file.format, camera=camera, rate=1.0, keypoint_set=OPENPOSE_HANDS
            )
    else:
        rate = None if KEYPOINTS.get(file.format).has_all_cameras else 1.0
        record = read_keypoints(file.path, format=file.format, camera=camera, rate=rate)
    return record


def keypoint_entries(
    draft: Draft, source: Source, records: Mapping[str, Keypoints], frame: Value | None,
    images: Mapping[str, ImageFrame], *, active: bool,
) -> None:
    """Enter the tables [[keypoints]] of one detector; as comments unless it is the one to use.

    Parameters
    ----------
    frame : image frame of the coordinates, of the cameras in `images`.
    """
    if not records:
        return
    format = next(iter(source.values())).format
    what = f"{format}, {', '.join(sorted({r.keypoint_set for r in records.values()}))}, {len(records)} cameras"
    text = f"{what}: used" if active else f"{what}: as comments, because one detector is enough to begin with"
    draft.note("keypoints", "sure" if active else "guess", text)
    if active and any(_hands_seen(record) for record in records.values()):
        body = Value("humanoid_hands", "likely", "the humanoid with fingers, as the keypoints have hands")
        draft.head["body"] = draft.note_value("body", body, "body")
    if frame is not None:
        draft.note_value(f"keypoints, {format}", frame, "frame")
    for name, record in records.items():
        why = KEYPOINTS.get(format).comment if KEYPOINTS.plugins(format) else ""
        entry = {"camera": Value(name), "file": Value(source[name].path), "format": Value(format, why=why)}
        if format == "openpose":
            of_two = source[name].points in _AMBIGUOUS_COUNTS
            why = f"{source[name].points} points" + ", recognised by the lengths of the bones" * of_two
            entry["set"] = Value(record.keypoint_set, "likely" if of_two else "sure", why)
        if frame is not None and name in images:
            entry["frame"] = frame
        draft.tables["keypoints"].append((active, entry))


def _hands_seen(record: Keypoints) -> bool:
    """Whether a record has points of hands, with some detected."""
    return record.keypoint_set in SETS_WITH_HANDS and bool(record.confidence[..., -2 * HAND_POINTS :].any())
