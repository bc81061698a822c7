"""A take that does not quite fit, read as far as it can be: every obstacle becomes a finding, with the way round it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from kinefit.calibration.check.findings import Finding, Severity
from kinefit.errors import KinefitError
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.guess.draft import Told
from kinefit.readers.guess.views import black_bars, picture
from kinefit.readers.take.file import CameraEntry, Take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.video import Video

_EITHER = Told(90, "guess", "clockwise or counter-clockwise: try 90, then 270")
_BARS = 0.02  # of the picture: narrower ones may be a camera's own dark rim
_ATTEMPTS = 12  # each goes round one obstacle


@dataclass(frozen=True, eq=False)
class Loaded:
    """What could be read.

    Parameters
    ----------
    take : Take
        As it must be written to be read: with the remedies of the findings.
    observations : Observations or None
        None where not even two cameras are left.
    findings : tuple of Finding
    """

    take: Take
    observations: Observations | None
    findings: tuple[Finding, ...]


def load_leniently(take: Take) -> Loaded:
    """Read a take; what cannot be read is left out or guessed, and told."""
    if take.calibration is None:
        return Loaded(
            take,
            None,
            (Finding("fault", "load", "The take names no cameras.", remedy="Add [[camera]] and [calibration]."),),
        )
    try:
        rig = read_calibration(take.calibration.file, unit=take.calibration.unit)
    except KinefitError as error:
        return Loaded(take, None, (_told(error),))
    findings: list[Finding] = []
    take = _known_cameras(take, rig, findings)
    take = replace(take, cameras=tuple(_fitting_picture(entry, rig, findings, take.rate) for entry in take.cameras))
    take = _framed_keypoints(take, rig, findings)
    for _ in range(_ATTEMPTS):
        try:
            return Loaded(take, load_observations(take), tuple(findings))
        except KinefitError as error:
            findings.append(_told(error))
            around = _without(take, error)
            if around is None:
                break
            take = around
    return Loaded(take, None, tuple(findings))


def _told(error: KinefitError, cameras: tuple[str, ...] = ()) -> Finding:
    where = ", ".join(str(part) for part in (error.file, error.place) if part)
    return Finding(
        "fault",
        "load",
        f"{where}: {error.problem}." if where else f"{error.problem}.",
        cameras,
        remedy=error.remedy or "",
    )


def _known_cameras(take: Take, rig: Rig, findings: list[Finding]) -> Take:
    """Without cameras that the calibration lacks."""
    strange = [entry.name for entry in take.cameras if entry.name not in rig]
    for name in strange:
        text = f"{name} is not in the calibration, which has {', '.join(rig.names)}; it is left out."
        remedy = "Correct its name in the take, or calibrate it too."
        findings.append(Finding("fault", "load", text, (name,), remedy=remedy))
    return _only(take, [entry.name for entry in take.cameras if entry.name in rig]) if strange else take


def _only(take: Take, names: list[str]) -> Take:
    return replace(
        take, cameras=tuple(c for c in take.cameras if c.name in names),
        keypoints=tuple(k for k in take.keypoints if k.camera in names),
    )  # fmt: skip


def _fitting_picture(entry: CameraEntry, rig: Rig, findings: list[Finding], rate: float | None) -> CameraEntry:
    """The entry with `image` or `rotation` as the video's picture wants it."""
    if entry.video is None:
        return entry
    calibrated, name = rig[entry.name].size, entry.name
    turned = calibrated if entry.rotation % 180 == 0 else calibrated[::-1]
    try:
        with Video(entry.video, rate=rate) as video:
            size, untold = video.size, entry.image == "as calibrated" and video.size != turned
            told = picture(calibrated, video, _EITHER) if untold else {}
            bars = 0 if untold else max(black_bars(video))
    except KinefitError as error:
        findings.append(_told(error, (name,)))
        return msgspec.structs.replace(entry, video=None, size=None)

    def say(severity: Severity, kind: str, text: str, remedy: str = "", sure: str = "") -> None:
        findings.append(Finding(severity, kind, f"{name} {text}.", (name,), sure, remedy))

    if entry.size and entry.size != size:
        problem = f"has a video of {size[0]}x{size[1]} px, but size = {list(entry.size)}"
        say("fault", "picture", problem, f"Leave size out of [[camera]] {name}.")
        entry = msgspec.structs.replace(entry, size=None)
    expected = _bars(turned, size)
    boxed = abs(bars - max(expected)) <= max(2.0, 0.2 * max(expected))
    sizes = f"the video has {size[0]}x{size[1]} px, the calibration {calibrated[0]}x{calibrated[1]}"
    where = "at the sides" if expected[0] > expected[1] else "above and below"
    with_bars = f"{sizes}, with bars of {max(expected):.1f} px {where}"
    if size == turned:
        if bars > _BARS * max(size):
            remedy = "Nothing, if it was calibrated with the bars; else calibrate on the same images."
            say("doubt", "picture", f"has black bars of {bars} px, though its video has the calibration's size", remedy)
    elif entry.image == "letterboxed" and boxed:
        say("note", "letterboxed", f"is letterboxed against the calibration, as the take says: {with_bars}")
    elif entry.image == "letterboxed":
        remedy = f'Is it image = "scaled" in [[camera]] {name}?'
        say("doubt", "picture", f"is said to be letterboxed ({with_bars}), but its black bars have {bars} px", remedy)
    elif entry.image == "scaled" and boxed and max(expected) >= 2:
        remedy = f'Write image = "letterboxed" into [[camera]] {name}.'
        say("fault", "letterboxed", f"is said to be scaled, but is letterboxed: {with_bars}", remedy)
        return msgspec.structs.replace(entry, image="letterboxed")
    elif entry.image == "scaled":
        say("note", "picture", f"is scaled against the calibration, as the take says: {sizes}")
    elif told:
        is_boxed = "image" in told and told["image"].value == "letterboxed"
        lines = [f'{k} = "{v.value}"' if isinstance(v.value, str) else f"{k} = {v.value}" for k, v in told.items()]
        what = f"is letterboxed against the calibration: {with_bars}" if is_boxed else f"has another image: {sizes}"
        sure = "; ".join(f"{v.sure.capitalize()}: {v.why}" for v in told.values()) + "."
        remedy = f"Write {' and '.join(lines)} into [[camera]] {name}."
        say("fault", "letterboxed" if is_boxed else "picture", f"{what}; the take does not say so", remedy, sure)
        return msgspec.structs.replace(entry, **{key: v.value for key, v in told.items()})
    return entry


def _bars(calibrated: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """[px] width of the bars (at the sides, above and below) of a letterboxed picture."""
    low = ImageFrame.letterboxed(calibrated, size).from_calibration(np.array([-0.5, -0.5])) + 0.5
    return float(low[0]), float(low[1])


def _framed_keypoints(take: Take, rig: Rig, findings: list[Finding]) -> Take:
    """With `frame` for keypoints that lack it and need it: detectors run on the video."""
    entries = {entry.name: entry for entry in take.cameras}
    out = []
    for source in take.keypoints:
        entry = entries[source.camera]
        differs = entry.image != "as calibrated" or entry.rotation != 0
        if source.frame is None and differs and source.format != "detect":
            text = (
                f"It is not stated in which image the keypoints of {source.camera} are: the video's, the calibration's?"
            )
            remedy = 'Write frame = "video" (as taken here) or frame = "calibration" into its [[keypoints]].'
            findings.append(Finding("doubt", "frame", text, (source.camera,), remedy=remedy))
            source = msgspec.structs.replace(source, frame="video")
        out.append(source)
    return replace(take, keypoints=tuple(out))


def _without(take: Take, error: KinefitError) -> Take | None:
    """The take with a way round an error: other frames, or without the file at fault; None where there is none."""
    frames = re.search(r"frames = \[(\d+), (\d+)\]", error.remedy or "")
    if frames and error.file == take.path:
        cut = int(frames[1]), int(frames[2])
        return replace(take, frames=cut) if take.frames != cut else None
    for source in take.keypoints:
        if any(_within(error.file, file) for file in (source.file, *_of_camera(take, source.camera)) if file) or (
            source.camera in (error.place or "").replace(",", " ").split() and "keypoints" in (error.place or "")
        ):
            left = [entry.camera for entry in take.keypoints if entry is not source]
            return _only(take, left) if len(set(left)) >= 2 else None
    return None


def _of_camera(take: Take, name: str) -> Iterator[Path]:
    for entry in take.cameras:
        if entry.name == name and entry.video:
            yield entry.video


def _within(file: object, place: Path) -> bool:
    return isinstance(file, str | Path) and (Path(file) == place or place in Path(file).parents)
