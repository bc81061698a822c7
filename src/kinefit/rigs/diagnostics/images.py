"""Check a camera's images: size, black bars, covered lens, noise.

Streams that freeze: a sensor repeats its last frame, to the bit, while time goes on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import KinefitError
from kinefit.findings import Edit, Finding, Severity, listed, runs_of
from kinefit.fitting.multiview.views import MIN_CONFIDENCE
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import DepthVideo, Keypoints
from kinefit.readers.guess.draft import Value
from kinefit.readers.guess.views import black_bars, picture
from kinefit.readers.take.entries import CameraEntry, Take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.take.videos import TakePictures
from kinefit.readers.videos.video import Video

_MIN_FROZEN_S = 0.25  # of a repeated frame: shorter ones are dropped frames, or a video of a third of its stated rate
_MIN_FROZEN_FRAMES = 5
_MIN_POINTS = 4  # of a frame; single points are held by programs that fill gaps
_MIN_PIXELS = 100  # of a depth image that measure something: images of an empty range are all alike
_TOLERANCE = 1e-9  # of the largest value: interpolation at the take's steps rounds equal rows
_MIN_CHANGED_SHARE = 0.8  # of the points in other frames: coordinates in whole pixels repeat often
_MIN_JUMP = 0.05
"""Median step of the points into or out of a repeated frame, as a share of the recording's: sensors have noise, and a
simulated body without noise comes to rest smoothly."""
_SEARCH_HZ = 4.0  # of depth images that are compared


def without_frozen(seen: Observations) -> tuple[Observations, list[Finding]]:
    """Exclude the repeated frames of frozen streams; a doubt on each names frames and times."""
    findings = list[Finding]()

    def thawed(record: Any, sensor: str, drop: Callable[[Any, NDArray], Any]) -> Any:
        runs = _depth_runs(record) if isinstance(record, DepthVideo) else _runs(_rows(record), record.rate)
        if not runs:
            return record
        findings.append(_finding(sensor, runs, record.times, seen.frames[0] if isinstance(record, Keypoints) else 0))
        flags = np.zeros(len(record.times), bool)
        for a, b in runs:
            flags[a:b] = True
        return drop(record, flags)

    keypoints = tuple(thawed(k, k.camera, Keypoints.without) for k in seen.keypoints)
    number = lambda k: f"markers {k + 1}" if len(seen.markers) > 1 else "markers"
    markers = tuple(thawed(m, number(k), _emptied) for k, m in enumerate(seen.markers))
    depth = tuple(thawed(d, d.sensor, lambda video, at: video.without(np.flatnonzero(at))) for d in seen.depth)
    sensors = tuple(replace(s, recording=thawed(s.recording, s.recording.sensor, _emptied)) for s in seen.sensors)
    return replace(seen, keypoints=keypoints, markers=markers, depth=depth, sensors=sensors), findings


def _finding(sensor: str, runs: Sequence[tuple[int, int]], times: NDArray, first: int) -> Finding:
    parts = [f"frames {first + a} to {first + b - 1} ({times[a]:.2f} to {times[b - 1]:.2f} s)" for a, b in runs]
    text = f"{sensor} is frozen in {', '.join(parts)}: it repeats one frame exactly, and these are excluded."
    confidence = "Certain: a person who stands still never gives equal numbers twice."
    remedy = "Nothing for these frames. Check its cable, buffer or recorder before the next recording."
    return Finding("doubt", "frozen", text, (sensor,), confidence, remedy)


def _emptied(record: Any, frames: NDArray) -> Any:
    """A record with NaN for all that it measured in some frames (F,) bool."""
    arrays = {name: np.array(values) for name, values in _arrays(record).items()}
    for values in arrays.values():
        values[frames] = np.nan
    return replace(record, **arrays)


def _arrays(record: Any) -> dict[str, NDArray]:
    """Arrays (F, points, ...) of numbers that a record of F frames holds."""
    values = {f.name: getattr(record, f.name) for f in fields(record)}
    return {
        name: v for name, v in values.items()
        if isinstance(v, np.ndarray) and v.ndim > 2 and len(v) == len(record.times) and v.dtype.kind == "f"
    }  # fmt: skip


def _rows(record: Any) -> NDArray:
    """(F, K, D) values of K points in each frame; no frames where the record does not hold its measurements."""
    values = record.points if isinstance(record, Keypoints) else next(iter(_arrays(record).values()), None)
    if values is None:
        return np.zeros((0, 0, 1))
    width = values.shape[-1] if isinstance(record, Keypoints) else int(np.prod(values.shape[2:]))
    return values.reshape(len(values), -1, width)


def _runs(x: NDArray, rate: float) -> list[tuple[int, int]]:
    """(start, stop) of the frames of points (F, K, D) that repeat the frame before `start`."""
    known = np.isfinite(x).all(axis=-1)
    if len(x) < 2 * _MIN_FROZEN_FRAMES or not known.any():
        return []
    step = np.linalg.norm(np.diff(x, axis=0), axis=-1)
    changed = ~(step <= _TOLERANCE * np.abs(x[known]).max()) & (known[1:] | known[:-1])
    equal = ~changed.any(axis=1) & (known[1:].sum(axis=1) >= _MIN_POINTS)
    least = max(_MIN_FROZEN_S * rate, _MIN_FROZEN_FRAMES)
    both = known[1:] & known[:-1]
    moving = np.where(both & ~equal[:, None], step, np.nan)
    steps = moving[np.isfinite(moving)]
    if not len(steps) or np.mean(changed[~equal][both[~equal]]) < _MIN_CHANGED_SHARE:
        return []

    def jumps(at: int) -> bool:
        own = moving[at][np.isfinite(moving[at])] if 0 <= at < len(moving) else np.zeros(0)
        return len(own) > 0 and float(np.median(own)) > _MIN_JUMP * float(np.median(steps))

    runs = [(a, b) for a, b in runs_of(equal) if b - a >= least and (jumps(a - 1) or jumps(b))]
    return [(a + 1, b + 1) for a, b in runs]


def _depth_runs(video: DepthVideo) -> list[tuple[int, int]]:
    """(start, stop) of the depth images that repeat the image before `start`."""
    step = max(int(video.rate / _SEARCH_HZ), 1)

    def alike(a: NDArray, b: NDArray) -> bool:
        return bool(np.sum(a > 0.0) >= _MIN_PIXELS and np.array_equal(a, b))

    def same(i: int, j: int) -> bool:
        return alike(video.frame(i).depth, video.frame(j).depth)

    tested = np.arange(0, len(video), step)
    images = (video.frame(int(i)).depth for i in tested)  # each is decoded once
    equal = np.array([alike(a, b) for a, b in pairwise(images)], bool)
    out = []
    for a, b in runs_of(equal) if not equal.all() else ():
        first, last = int(tested[a]), int(tested[b])
        while first > 0 and same(first - 1, first):
            first -= 1
        while last + 1 < len(video) and same(last, last + 1):
            last += 1
        if last - first >= max(_MIN_FROZEN_S * video.rate, _MIN_FROZEN_FRAMES):
            out.append((first + 1, last + 1))
    return out


_EITHER = Value(90, "guess", "clockwise or counter-clockwise: try 90, then 270")
_MAX_DARK_BORDER = 0.02  # of the image: narrower bars may be a camera's own dark border
_MIN_BAR_ERROR_PX = 2.0  # video codecs smear edges
_MIN_BAR_ERROR = 0.2  # of a bar's width, the same

_COVER_SEARCH_HZ = 4.0  # of depth images that are tested for a covered lens, before its interval is refined
_MIN_COVERED_FRAMES = 2  # a single bad image is the sensor's own
_MAX_COVERED_SHARE = 0.1  # of the pixels that the camera measures in most images
_MIN_MEASURED_SHARE = 0.4  # of the pixels: cameras that measure the person alone see nothing in an empty room, either
_COVER_DISTANCE = 0.3  # [m] of objects that cover the lens
_COVER_DISTANCE_RATIO = 1.2  # the same, to the sensor's stated minimal range
_MIN_PERSON_POINTS = 5
_MIN_UNSEEN_S = 0.25  # of intervals without a person in which a video's images are tested
_MAX_INTERVALS = 8  # of them, the longest
_MAX_CONTRAST_COVERED = 0.35  # to the contrast of images with a person: light comes through a hand
_MIN_CHANGE_COVERED = 0.3  # of half the image, to the same contrast: more than a person who leaves
_MAX_TRIPLES = 24  # of consecutive depth images, from which noise is estimated
_MIN_TRIPLES = 3
_NO_STATIC_PIXELS = np.zeros(0), np.zeros((0, 2))  # times and noise of a camera without static pixels
_NOISE_GROWTH = 1.4e-3  # [1/m] noise by squared depth that a sensor may have beyond its sigma (Khoshelham 2012)
_OUTLIER_SIGMAS = 6.0
_MAX_NOISE_RATIO = 1.5  # to the stated sigma
_MAX_UNSTABLE_SHARE = 0.1  # of static pixels that are missing in one image; single Kinects: 0.01 to 0.04


def fit_image(
    entry: CameraEntry, calibrated: tuple[int, int], rate: float | None, *, frames: int = 5
) -> tuple[CameraEntry, list[Finding]]:
    """Compare a video's image with the calibration's, and correct `image` or `rotation` of the camera's entry.

    Parameters
    ----------
    entry : of the camera in the take.
    calibrated : (width, height) [px] of the calibration's image.
    rate : float [Hz] of the take, where it states one.
    frames : int, number of images that are searched for black bars.

    Returns
    -------
    The corrected entry, and findings on the original one.
    """
    if entry.video is None:
        return entry, []
    turned = calibrated if entry.rotation % 180 == 0 else calibrated[::-1]
    try:
        with Video(entry.video, rate=rate) as video:
            size, unstated = video.size, entry.image == "as calibrated" and video.size != turned
            guessed = picture(calibrated, video, _EITHER) if unstated else {}
            bars = 0 if unstated else max(black_bars(video, frames))
    except KinefitError as error:
        return msgspec.structs.replace(entry, video=None, size=None), [finding_of(error, (entry.name,))]
    findings = []

    def add(severity: Severity, kind: str, text: str, remedy: str = "", sure: str = "", **keys: str | None) -> None:
        edits = tuple(Edit("camera", key, value, entry.name) for key, value in keys.items())
        findings.append(Finding(severity, kind, f"{entry.name} {text}.", (entry.name,), sure, remedy, edits))

    if entry.size and entry.size != size:
        problem = f"has a video of {size[0]}x{size[1]} px, but size = {list(entry.size)}"
        add("fault", "picture", problem, f"Leave size out of [[camera]] {entry.name}.", size=None)
        entry = msgspec.structs.replace(entry, size=None)
    expected = _bars(turned, size)
    tolerance = max(_MIN_BAR_ERROR_PX, _MIN_BAR_ERROR * max(expected))
    boxed = abs(bars - max(expected)) <= tolerance
    sizes = f"the video has {size[0]}x{size[1]} px, the calibration {calibrated[0]}x{calibrated[1]}"
    where = "at the sides" if expected[0] > expected[1] else "above and below"
    with_bars = f"{sizes}, with bars of {max(expected):.1f} px {where}"
    if size == turned:
        if bars > _MAX_DARK_BORDER * max(size):
            remedy = "If it was calibrated without the bars, calibrate it again on images with bars."
            add("doubt", "picture", f"has black bars of {bars} px, but its video has the calibration's size", remedy)
    elif entry.image == "letterboxed" and boxed:
        add("note", "letterboxed", f"is letterboxed against the calibration, as the take says: {with_bars}")
    elif entry.image == "letterboxed":
        text = f"is letterboxed by the take ({with_bars}), but its black bars have {bars} px"
        if bars < max(expected) - tolerance:
            add("fault", "picture", text, image='"scaled"')
        else:
            remedy, sure = f'Try image = "scaled" in [[camera]] {entry.name}.', "A guess: a dark scene widens the bars."
            add("doubt", "picture", text, remedy, sure, image='"scaled"')
    elif entry.image == "scaled" and boxed and max(expected) >= _MIN_BAR_ERROR_PX:
        problem = f"is scaled by the take, but its video is letterboxed: {with_bars}"
        add("fault", "letterboxed", problem, image='"letterboxed"')
        return msgspec.structs.replace(entry, image="letterboxed"), findings
    elif entry.image == "scaled":
        add("note", "picture", f"is scaled against the calibration, as the take says: {sizes}")
    elif guessed:
        is_boxed = "image" in guessed and guessed["image"].value == "letterboxed"
        keys = {k: f'"{v.value}"' if isinstance(v.value, str) else str(v.value) for k, v in guessed.items()}
        what = f"is letterboxed against the calibration: {with_bars}" if is_boxed else f"has another size: {sizes}"
        sure = "; ".join(f"{v.sure.capitalize()}: {v.why}" for v in guessed.values()) + "."
        kind = "letterboxed" if is_boxed else "picture"
        add("fault", kind, f"{what}; the take does not say so", "", sure, **keys)
        return msgspec.structs.replace(entry, **{key: v.value for key, v in guessed.items()}), findings
    return entry, findings


def finding_of(error: KinefitError, cameras: tuple[str, ...] = ()) -> Finding:
    """Fault for an input that cannot be read."""
    where = ", ".join(str(part) for part in (error.file, error.place) if part)
    text = f"{where}: {error.problem}." if where else f"{error.problem}."
    cut = re.search(r"frames = (\[\d+, \d+\])", error.remedy or "")
    edits = (Edit("take", "frames", cut[1]),) if cut and str(error.file).endswith(".toml") else ()
    return Finding("fault", "load", text, cameras, remedy=error.remedy or "", edits=edits)


def _bars(calibrated: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """Widths [px] of the bars of a letterboxed image: at the sides, above and below."""
    low = ImageFrame.letterboxed(calibrated, size).from_calibration(np.array([-0.5, -0.5])) + 0.5
    return float(low[0]), float(low[1])


def load_uncovered(take: Take) -> Observations:
    """Load the observations of a take without frozen frames and images of covered depth cameras; its notes name them.

    Raises
    ------
    KinefitError
        As `load_observations`.
    """
    seen, frozen = without_frozen(load_observations(take))
    seen, covered = without_covered(take, seen)
    found = (*frozen, *covered)
    return replace(seen, notes=(*seen.notes, *(f"{f.text} {f.remedy.rstrip('.')}" for f in found)))


def without_covered(take: Take, seen: Observations) -> tuple[Observations, list[Finding]]:
    """Drop images of depth cameras whose lens was covered; and findings on covered cameras, with times.

    Video cameras are tested too, in intervals in which no person is detected.
    """
    findings, depth = [], []
    for video in seen.depth:
        runs = _covered_runs(video)
        for a, b in runs:
            what = f"its images are empty or nearer than {_cover_distance(video):.2f} m, and excluded"
            findings.append(_covered(video.sensor, video.times[a], video.times[b - 1], what))
        depth.append(video.without(np.concatenate([np.arange(*run) for run in runs])) if runs else video)
    with TakePictures(take, seen) as pictures:
        for camera in dict.fromkeys(k.camera for k in seen.keypoints if k.camera in seen.videos):
            own = [k for k in seen.keypoints if k.camera == camera]
            points = np.max([(k.confidence > MIN_CONFIDENCE).sum(axis=-1).max(axis=1, initial=0) for k in own], axis=0)
            for a, b in _flat_runs(points >= _MIN_PERSON_POINTS, seen.rate, partial(pictures, camera)):
                findings.append(_covered(camera, own[0].times[a], own[0].times[b - 1], "its image is flat"))
    return replace(seen, depth=tuple(depth)), findings


def _covered(camera: str, start: float, stop: float, what: str) -> Finding:
    text = f"The lens of {camera} is probably covered from {start:.2f} to {stop:.2f} s: {what}."
    remedy = "Keep the lens free, or cut the take with frames = [first, last] in [take]."
    return Finding("doubt", "covered", text, (camera,), remedy=remedy)


def _cover_distance(video: DepthVideo) -> float:
    """Largest distance [m] of an object that covers the lens."""
    return max(_COVER_DISTANCE, _COVER_DISTANCE_RATIO * video.near)


def _covered_runs(video: DepthVideo) -> list[tuple[int, int]]:
    """Frames (first, last + 1) in which a depth camera measures almost none of the pixels that it usually measures."""

    @cache
    def shares(i: int) -> tuple[float, float]:
        """Shares of the pixels that measure the scene, and an object on the lens."""
        depth = video.frame(i).depth[::2, ::2]
        near = _cover_distance(video)
        return float((depth > near).mean()), float(((depth > 0.0) & (depth <= near)).mean())

    step = max(int(video.rate / _COVER_SEARCH_HZ), 1)
    tested = range(0, len(video), step)
    reference = 0.0 if video.on_body else float(np.quantile([shares(i)[0] for i in tested], 0.75))

    def is_covered(i: int) -> bool:
        scene, lens = shares(i)
        return scene < _MAX_COVERED_SHARE * reference and max(reference, lens) > _MIN_MEASURED_SHARE

    out = []
    for a, b in runs_of(np.array([is_covered(i) for i in tested])):
        first, last = a * step, (b - 1) * step
        while first > 0 and is_covered(first - 1):
            first -= 1
        while last + 1 < len(video) and is_covered(last + 1):
            last += 1
        if last + 1 - first >= _MIN_COVERED_FRAMES:
            out.append((first, last + 1))
    return out


def _flat_runs(
    shows: NDArray, rate: float, image: Callable[[int], tuple[NDArray, ImageFrame] | None]
) -> list[tuple[int, int]]:
    """Frames (first, last + 1) without a person in which a camera's image is flat, compared with those of a person.

    shows (F,) bool: whether a frame shows a person. rate [Hz].
    """
    runs = [run for run in runs_of(~shows) if run[1] - run[0] >= max(_MIN_UNSEEN_S * rate, _MIN_COVERED_FRAMES)]
    shown = np.flatnonzero(shows)
    if not runs or not len(shown):
        return []

    def grey(frame: int) -> NDArray | None:
        found = image(int(frame))
        return None if found is None else cv2.resize(found[0].mean(axis=-1), (32, 24), interpolation=cv2.INTER_AREA)

    references = [g for f in shown[np.linspace(0, len(shown) - 1, 5).astype(int)] if (g := grey(f)) is not None]
    if not references:
        return []
    reference = np.median(references, axis=0)

    def is_covered(frame: int) -> bool:
        g = grey(frame)
        flat = g is not None and g.std() < _MAX_CONTRAST_COVERED * reference.std()
        return flat and np.median(np.abs(g - reference)) > _MIN_CHANGE_COVERED * reference.std()

    longest = sorted(runs, key=lambda run: run[0] - run[1])[:_MAX_INTERVALS]
    return sorted(run for run in longest if all(map(is_covered, np.linspace(run[0], run[1] - 1, 5)[1:4].astype(int))))


def noise_findings(take: Take, videos: Sequence[DepthVideo]) -> list[Finding]:
    """Findings on depth cameras whose static pixels are noisier than stated, or often missing.

    The usual cause is other light of the same wavelength.
    """
    out = []
    for entry in take.depth:
        others = [v for v in videos if v.sensor != entry.name]
        times, values = next((_instability(v, entry.sigma) for v in videos if v not in others), _NO_STATIC_PIXELS)
        noise, unstable = np.quantile(values, 0.75, axis=0) if len(times) else (0.0, 0.0)
        if noise < _MAX_NOISE_RATIO and unstable < _MAX_UNSTABLE_SHARE:
            continue
        how = "flickers" if noise < _MAX_NOISE_RATIO else f"is noisier than stated, by a factor of {noise:.1f}"
        text = f"{entry.name} {how}: from image to image {100 * unstable:.0f} % of the static pixels are lost or jump"
        both = np.array([any(v.times[0] <= t <= v.times[-1] for v in others) for t in times])
        if min(both.sum(), (~both).sum()) >= _MIN_TRIPLES:
            a, b = (100.0 * np.median(values[which, 1]) for which in (both, ~both))
            text += f" ({a:.0f} % while {listed(v.sensor for v in others)} runs, {b:.0f} % else)"
        remedy = "Avoid overlapping views or stagger the cameras in time, and avoid sunlight; or set a larger sigma."
        text += ". Infrared light of another source is the most common cause."
        out.append(Finding("doubt", "noise", text, (entry.name,), remedy=remedy))
    return out


def _instability(video: DepthVideo, sigma: float) -> tuple[NDArray, NDArray]:
    """Times (T,) [s], and (T, 2): temporal noise of static pixels as a ratio to the stated, share of missing ones.

    Computed over three consecutive images, so that the step of a person who enters or leaves is not counted. Empty if
    the camera measures the person alone.
    """
    middles = np.setdiff1d(np.arange(1, len(video) - 1), np.r_[video.gaps, video.gaps - 1])
    thin = max(min(video.size) // 120, 1)
    tested = middles[np.unique(np.linspace(0, len(middles) - 1, _MAX_TRIPLES).astype(int))] if len(middles) else middles
    triples = [np.stack([video.frame(int(i) + k).depth[::thin, ::thin] for k in (-1, 0, 1)]) for i in tested]
    if len(triples) < _MIN_TRIPLES:
        return _NO_STATIC_PIXELS
    measurable = np.mean([t[1] > 0.0 for t in triples], axis=0) > 0.5
    if measurable.mean() < _MIN_MEASURED_SHARE:
        return _NO_STATIC_PIXELS
    out = []
    for before, z, after in triples:
        ends = (before > 0.0) & (after > 0.0) & measurable
        measured = ends & (z > 0.0)
        stated = np.maximum(sigma, _NOISE_GROWTH * np.square(after))
        second = np.abs(before - 2.0 * z + after) / stated
        rests = ends & (np.abs(before - after) < _OUTLIER_SIGMAS * stated)
        lost = rests & ((z <= 0.0) | (np.abs(z - after) > _OUTLIER_SIGMAS * stated))
        noise = float(np.median(second[measured])) / (0.6745 * np.sqrt(6.0)) if measured.any() else 0.0
        out.append((noise, lost.sum() / max(rests.sum(), 1)))
    return video.times[tested], np.array(out)
