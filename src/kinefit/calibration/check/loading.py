"""A take that does not quite fit, read as far as it can be: every obstacle becomes a finding, with the way round it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from kinefit.diagnostics.images import finding_of, fit_image
from kinefit.errors import KinefitError
from kinefit.findings import Finding
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations, load_observations

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
        return Loaded(take, None, (finding_of(error),))
    findings: list[Finding] = []
    take = _known_cameras(take, rig, findings)
    cameras = []
    for entry in take.cameras:
        fitting, found = fit_image(entry, rig[entry.name].size, take.rate)
        cameras.append(fitting)
        findings += found
    take = replace(take, cameras=tuple(cameras))
    take = _framed_keypoints(take, rig, findings)
    for _ in range(_ATTEMPTS):
        try:
            return Loaded(take, load_observations(take), tuple(findings))
        except KinefitError as error:
            findings.append(finding_of(error))
            around = _without(take, error)
            if around is None:
                break
            take = around
    return Loaded(take, None, tuple(findings))


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
