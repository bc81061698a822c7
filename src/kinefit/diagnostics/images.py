"""Whether a video's image is what the take says became of the calibration's: sizes, and black bars."""

from __future__ import annotations

import msgspec
import numpy as np

from kinefit.errors import KinefitError
from kinefit.findings import Finding, Severity
from kinefit.geometry.camera import ImageFrame
from kinefit.readers.guess.draft import Told
from kinefit.readers.guess.views import black_bars, picture
from kinefit.readers.take.file import CameraEntry
from kinefit.readers.video import Video

_EITHER = Told(90, "guess", "clockwise or counter-clockwise: try 90, then 270")
_MAX_DARK_BORDER = 0.02  # of the image: narrower bars may be a camera's own dark border
_MIN_BAR_ERROR_PX = 2.0  # video codecs smear edges
_MIN_BAR_ERROR = 0.2  # of a bar's width, the same


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
