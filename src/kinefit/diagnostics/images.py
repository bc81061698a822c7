"""What a camera's images show to be wrong: sizes, black bars, a covered lens, noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import KinefitError
from kinefit.findings import Finding, Severity, listed, runs_of
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import DepthVideo
from kinefit.readers.guess.draft import Value
from kinefit.readers.guess.views import black_bars, picture
from kinefit.readers.take.file import CameraEntry, Take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.take.pictures import TakePictures
from kinefit.readers.video import Video

_EITHER = Value(90, "guess", "clockwise or counter-clockwise: try 90, then 270")
_MAX_DARK_BORDER = 0.02  # of the image: narrower bars may be a camera's own dark border
_MIN_BAR_ERROR_PX = 2.0  # video codecs smear edges
_MIN_BAR_ERROR = 0.2  # of a bar's width, the same

_LOOKS_HZ = 4.0  # depth images in which a covered lens is looked for; where it begins and ends is found to a frame
_MIN_COVERED_FRAMES = 2  # a single bad image is the sensor's own
_MAX_SEEN_COVERED = 0.1  # of what a camera measures in most images
_MIN_MEASURED = 0.4  # of the pixels: a camera that measures the person alone sees nothing of an empty place, either
_ON_LENS_M, _ON_LENS = 0.3, 1.2  # [m], and times the stated least range, within which lies what covers a lens
_CONFIDENT, _FEW_POINTS = 0.3, 5  # detections by which an image shows somebody
_MIN_UNSEEN_S = 0.25  # stretches without anybody in which images of a video are looked at
_MAX_STRETCHES = 8  # of them, the longest
_MAX_CONTRAST_COVERED = 0.35  # of the contrast in images that show somebody: light comes through a hand
_MIN_CHANGE_COVERED = 0.3  # of the same contrast, by which half of the image changes: not where a person walks off
_TRIPLES = 24  # of consecutive depth images, in which noise is looked at
_MIN_TRIPLES = 3
_NOTHING = np.zeros(0), np.zeros((0, 2))  # times and noise of a camera in which nothing rests
_NOISE_GROWTH = 1.4e-3  # [1/m] noise by squared depth that a sensor may have beyond its sigma (Khoshelham 2012)
_OUTLIER_SIGMAS = 6.0
_MAX_NOISE = 1.5  # times the stated
_MAX_UNSTABLE = 0.1  # of resting pixels that fall out of one image; Kinects alone: 0.01 to 0.04


def fit_image(
    entry: CameraEntry, calibrated: tuple[int, int], rate: float | None, *, frames: int = 5
) -> tuple[CameraEntry, list[Finding]]:
    """The entry with `image` or `rotation` as the video's image wants it, and what is wrong with those it has.

    Parameters
    ----------
    entry : of the camera in the take.
    calibrated : (width, height) [px] of the calibration's image.
    rate : float [Hz] of the take, where it states one.
    frames : int, how many images of the video black bars are looked for in.
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

    def add(severity: Severity, kind: str, text: str, remedy: str = "", sure: str = "") -> None:
        findings.append(Finding(severity, kind, f"{entry.name} {text}.", (entry.name,), sure, remedy))

    if entry.size and entry.size != size:
        problem = f"has a video of {size[0]}x{size[1]} px, but size = {list(entry.size)}"
        add("fault", "picture", problem, f"Leave size out of [[camera]] {entry.name}.")
        entry = msgspec.structs.replace(entry, size=None)
    expected = _bars(turned, size)
    tolerance = max(_MIN_BAR_ERROR_PX, _MIN_BAR_ERROR * max(expected))
    boxed = abs(bars - max(expected)) <= tolerance
    sizes = f"the video has {size[0]}x{size[1]} px, the calibration {calibrated[0]}x{calibrated[1]}"
    where = "at the sides" if expected[0] > expected[1] else "above and below"
    with_bars = f"{sizes}, with bars of {max(expected):.1f} px {where}"
    if size == turned:
        if bars > _MAX_DARK_BORDER * max(size):
            remedy = "Nothing, if it was calibrated with the bars; else calibrate on the same images."
            add("doubt", "picture", f"has black bars of {bars} px, though its video has the calibration's size", remedy)
    elif entry.image == "letterboxed" and boxed:
        add("note", "letterboxed", f"is letterboxed against the calibration, as the take says: {with_bars}")
    elif entry.image == "letterboxed":
        shows = bars < max(expected) - tolerance  # dark scenes only widen them
        line = 'image = "scaled"'
        remedy = f"Write {line} into [[camera]] {entry.name}." if shows else f"Is it {line} in [[camera]] {entry.name}?"
        text = f"is said to be letterboxed ({with_bars}), but its black bars have {bars} px"
        add("fault" if shows else "doubt", "picture", text, remedy)
    elif entry.image == "scaled" and boxed and max(expected) >= _MIN_BAR_ERROR_PX:
        remedy = f'Write image = "letterboxed" into [[camera]] {entry.name}.'
        add("fault", "letterboxed", f"is said to be scaled, but is letterboxed: {with_bars}", remedy)
        return msgspec.structs.replace(entry, image="letterboxed"), findings
    elif entry.image == "scaled":
        add("note", "picture", f"is scaled against the calibration, as the take says: {sizes}")
    elif guessed:
        is_boxed = "image" in guessed and guessed["image"].value == "letterboxed"
        lines = [f'{k} = "{v.value}"' if isinstance(v.value, str) else f"{k} = {v.value}" for k, v in guessed.items()]
        what = f"is letterboxed against the calibration: {with_bars}" if is_boxed else f"has another image: {sizes}"
        sure = "; ".join(f"{v.sure.capitalize()}: {v.why}" for v in guessed.values()) + "."
        remedy = f"Write {' and '.join(lines)} into [[camera]] {entry.name}."
        add("fault", "letterboxed" if is_boxed else "picture", f"{what}; the take does not say so", remedy, sure)
        return msgspec.structs.replace(entry, **{key: v.value for key, v in guessed.items()}), findings
    return entry, findings


def finding_of(error: KinefitError, cameras: tuple[str, ...] = ()) -> Finding:
    """What cannot be read, as a fault."""
    where = ", ".join(str(part) for part in (error.file, error.place) if part)
    text = f"{where}: {error.problem}." if where else f"{error.problem}."
    return Finding("fault", "load", text, cameras, remedy=error.remedy or "")


def _bars(calibrated: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """[px] width of the bars (at the sides, above and below) of a letterboxed image."""
    low = ImageFrame.letterboxed(calibrated, size).from_calibration(np.array([-0.5, -0.5])) + 0.5
    return float(low[0]), float(low[1])


def load_uncovered(take: Take) -> Observations:
    """Everything that a take names, without the images of covered depth cameras; its notes say which lens was covered.

    Raises
    ------
    KinefitError
        What `load_observations` raises.
    """
    seen, found = without_covered(take, load_observations(take))
    return replace(seen, notes=(*seen.notes, *(f"{f.text} {f.remedy.rstrip('.')}" for f in found)))


def without_covered(take: Take, seen: Observations) -> tuple[Observations, list[Finding]]:
    """What the sensors of a take saw, without the images of depth cameras whose lens was covered; who was, and when.

    The findings are of video cameras, too: their images are looked at where nobody is detected in them.
    """
    findings, depth = [], []
    for video in seen.depth:
        runs = _covered_runs(video)
        for a, b in runs:
            what = f"its images are empty or nearer than {_on_lens(video):.2f} m, and are left out"
            findings.append(_covered(video.sensor, video.times[a], video.times[b - 1], what))
        depth.append(video.without(np.concatenate([np.arange(*run) for run in runs])) if runs else video)
    with TakePictures(take, seen) as pictures:
        for camera in dict.fromkeys(k.camera for k in seen.keypoints if k.camera in seen.videos):
            own = [k for k in seen.keypoints if k.camera == camera]
            points = np.max([(k.confidence > _CONFIDENT).sum(axis=-1).max(axis=1, initial=0) for k in own], axis=0)
            for a, b in _flat_runs(points >= _FEW_POINTS, seen.rate, partial(pictures, camera)):
                findings.append(_covered(camera, own[0].times[a], own[0].times[b - 1], "its image is flat"))
    return replace(seen, depth=tuple(depth)), findings


def _covered(camera: str, start: float, stop: float, what: str) -> Finding:
    text = f"{camera} sees nothing from {start:.2f} to {stop:.2f} s: {what}. Was its lens covered?"
    remedy = "Keep hands and cloths off the lens, or cut the take with frames = [first, last] in [take]."
    return Finding("doubt", "covered", text, (camera,), remedy=remedy)


def _on_lens(video: DepthVideo) -> float:
    """[m] within which lies what covers the lens."""
    return max(_ON_LENS_M, _ON_LENS * video.near)


def _covered_runs(video: DepthVideo) -> list[tuple[int, int]]:
    """(first, last + 1) frames in which a depth camera measures next to nothing of what it measures in most others."""

    @cache
    def shares(i: int) -> tuple[float, float]:
        """Of the pixels, those that measure the scene, and what is on the lens."""
        depth = video.frame(i).depth[::2, ::2]
        return float((depth > _on_lens(video)).mean()), float(((depth > 0.0) & (depth <= _on_lens(video))).mean())

    step = max(int(video.rate / _LOOKS_HZ), 1)
    looks = range(0, len(video), step)
    usual = 0.0 if video.on_body else float(np.quantile([shares(i)[0] for i in looks], 0.75))

    def is_covered(i: int) -> bool:
        scene, lens = shares(i)
        return scene < _MAX_SEEN_COVERED * usual and max(usual, lens) > _MIN_MEASURED

    out = []
    for a, b in runs_of(np.array([is_covered(i) for i in looks])):
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
    """(first, last + 1) frames in which nobody is shown (F,) and a camera's images are flat, beside those that show."""
    runs = [run for run in runs_of(~shows) if run[1] - run[0] >= max(_MIN_UNSEEN_S * rate, _MIN_COVERED_FRAMES)]
    there = np.flatnonzero(shows)
    if not runs or not len(there):
        return []

    def grey(frame: int) -> NDArray | None:
        found = image(int(frame))
        return None if found is None else cv2.resize(found[0].mean(axis=-1), (32, 24), interpolation=cv2.INTER_AREA)

    some = [g for f in there[np.linspace(0, len(there) - 1, 5).astype(int)] if (g := grey(f)) is not None]
    if not some:
        return []
    usual = np.median(some, axis=0)

    def is_covered(frame: int) -> bool:
        g = grey(frame)
        flat = g is not None and g.std() < _MAX_CONTRAST_COVERED * usual.std()
        return flat and np.median(np.abs(g - usual)) > _MIN_CHANGE_COVERED * usual.std()

    longest = sorted(runs, key=lambda run: run[0] - run[1])[:_MAX_STRETCHES]
    return sorted(run for run in longest if all(map(is_covered, np.linspace(run[0], run[1] - 1, 5)[1:4].astype(int))))


def noise_findings(take: Take, videos: Sequence[DepthVideo]) -> list[Finding]:
    """Depth cameras whose resting pixels scatter or fall out more than is stated: by light of the same kind, often."""
    out = []
    for entry in take.depth:
        others = [v for v in videos if v.sensor != entry.name]
        times, values = next((_instability(v, entry.sigma) for v in videos if v not in others), _NOTHING)
        noise, unstable = np.quantile(values, 0.75, axis=0) if len(times) else (0.0, 0.0)
        if noise < _MAX_NOISE and unstable < _MAX_UNSTABLE:
            continue
        how = "flickers" if noise < _MAX_NOISE else f"is noisier than stated, by a factor of {noise:.1f}"
        text = f"{entry.name} {how}: from image to image {100 * unstable:.0f} % of the pixels at rest are lost or jump"
        both = np.array([any(v.times[0] <= t <= v.times[-1] for v in others) for t in times])
        if min(both.sum(), (~both).sum()) >= _MIN_TRIPLES:
            a, b = (100.0 * np.median(values[which, 1]) for which in (both, ~both))
            text += f" ({a:.0f} % while {listed(v.sensor for v in others)} runs, {b:.0f} % else)"
        remedy = "Run depth cameras in turn or in step, point them apart, keep sunlight out; or state a larger sigma."
        text += ". Is other light of the same kind in view?"
        out.append(Finding("doubt", "noise", text, (entry.name,), remedy=remedy))
    return out


def _instability(video: DepthVideo, sigma: float) -> tuple[NDArray, NDArray]:
    """Times (T,) [s] and of each (T, 2): noise of resting pixels in time over the stated, share of those that fall out.

    By three consecutive images: a person who comes or goes makes a step, which is not counted. Nothing where the
    camera measures the person alone.
    """
    middles = np.setdiff1d(np.arange(1, len(video) - 1), np.r_[video.gaps, video.gaps - 1])
    thin = max(min(video.size) // 120, 1)
    looks = middles[np.unique(np.linspace(0, len(middles) - 1, _TRIPLES).astype(int))] if len(middles) else middles
    triples = [np.stack([video.frame(int(i) + k).depth[::thin, ::thin] for k in (-1, 0, 1)]) for i in looks]
    if len(triples) < _MIN_TRIPLES:
        return _NOTHING
    often = np.mean([t[1] > 0.0 for t in triples], axis=0) > 0.5
    if often.mean() < _MIN_MEASURED:
        return _NOTHING
    out = []
    for before, z, after in triples:
        ends = (before > 0.0) & (after > 0.0) & often
        measured = ends & (z > 0.0)
        stated = np.maximum(sigma, _NOISE_GROWTH * np.square(after))
        second = np.abs(before - 2.0 * z + after) / stated
        rests = ends & (np.abs(before - after) < _OUTLIER_SIGMAS * stated)
        lost = rests & ((z <= 0.0) | (np.abs(z - after) > _OUTLIER_SIGMAS * stated))
        noise = float(np.median(second[measured])) / (0.6745 * np.sqrt(6.0)) if measured.any() else 0.0
        out.append((noise, lost.sum() / max(rests.sum(), 1)))
    return video.times[looks], np.array(out)
