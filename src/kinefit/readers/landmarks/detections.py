"""The file of `kinefit detect`, `*.npz`, version 1: people of one video, their landmarks and masks.

A compressed archive of numpy arrays (`numpy.load(path, allow_pickle=False)` reads it); F frames, P people, pixels of
the video's image, the centre of the first pixel is (0, 0):

    format ()                  text "kinefit detections"
    version ()                 1
    key ()                     text that identifies the video, networks and settings: another key, another result
    camera ()                  text
    rate ()                    [Hz]
    size (2,)                  width, height [px]
    points (F, P, K, 2)        float32 [px], landmarks; NaN where a person is not detected
    confidence (F, P, K)       float32, 0..1; 0 where a person is not detected
    names (K,)                 text, optional: names of the landmarks; without, the 33 of MEDIAPIPE_33
    keypoint_set ()            text, with names: the set that they are of, "" for landmarks of the body
    network ()                 text, optional: file of a network of one's own that found them
    mask_runs (N,)             uint32, run lengths down the columns, beginning outside of the person (COCO's RLE)
    lifted (F, P, K, 3)        float32 [m], optional: landmarks in space, see Detections; NaN where not detected
    hands (F, P, 2, 21, 2)     float32 [px], optional: landmarks of MEDIAPIPE_HAND_21 of the left and the right hand
    hand_confidence (F, P, 2, 21)   float32, 0..1, with hands; 0 where a hand is not detected
    face (F, P, 478, 2)        float32 [px], optional: points of MEDIAPIPE_478; NaN where a face is not detected
    face_confidence (F, P, 478)     float32, 0..1, with face; 0 where a face is not detected
    times (F,)                 float64 [s], optional: when each frame is shown, from the first on; without: at the rate
    looked (F,)                bool, optional: frames whose image was looked at; without: all
    mask_starts (F * P + 1,)   start of each mask in mask_runs, by frame, then person; two equal starts: no mask
"""

from __future__ import annotations

from glob import escape
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_npz, regular
from kinefit.errors import FileError, KinefitError, command
from kinefit.observations import Detections

FORMAT, VERSION = "kinefit detections", 1
_DAMAGE = (OSError, ValueError, KeyError, TypeError)


def detections_file(take: str | PathLike[str], camera: str) -> Path:
    """Path of the detections of one camera of a take, as `kinefit detect` writes them: TAKE-detect/CAMERA.npz."""
    take = Path(take)
    safe = "".join(c if c.isalnum() or c in " ._-" else "_" for c in camera)
    return take.with_name(f"{take.stem}-detect") / f"{safe}.npz"


@checked
def read_detections(path: str | PathLike[str]) -> Detections:
    """Read the detections of one video, as the built-in detector wrote them.

    Raises
    ------
    FileError
        No such file, not one of the detector's, damaged, or of a later version.
    """
    file = Path(path)
    if not regular(file).is_file():
        raise FileError("no such file of detections", file=file, remedy=f"Run: {_anew(file)}")
    again = f"Detect again: {_anew(file, '--force')}"
    try:
        arrays = _load(file)
    except _DAMAGE as error:
        problem = f"not a file of the built-in detector, or damaged ({error})"
        raise FileError(problem, file=file, remedy=again) from error
    try:
        width, height = (int(n) for n in arrays["size"])
        optional = ("lifted", "hands", "hand_confidence", "times", "face", "face_confidence", "looked")
        more: dict[str, Any] = {name: arrays.get(name) for name in optional}
        if "names" in arrays:
            more |= {"keypoint_set": str(arrays["keypoint_set"]), "names": tuple(map(str, arrays["names"]))}
        found = Detections(
            str(arrays["camera"]), float(arrays["rate"]), (width, height), arrays["points"], arrays["confidence"],
            arrays["mask_runs"], arrays["mask_starts"], str(file), network=str(arrays.get("network", "")), **more,
        )  # fmt: skip
    except (KinefitError, KeyError, ValueError, TypeError, IndexError, OverflowError) as error:
        raise FileError(f"its arrays do not fit together ({error})", file=file, remedy=again) from error
    if not found.rate > 0 or not np.isfinite(found.confidence).all() or np.isinf(found.points).any():
        raise FileError("impossible values", file=file, remedy=again)
    return found


def detections_key(path: str | PathLike[str], part: str = "key") -> str | None:
    """The key of a file of detections (its video, networks and settings); None if it is missing or damaged.

    `part` may be another text of the file.
    """
    try:
        return str(_load(Path(path), part)[part])
    except (FileError, *_DAMAGE):
        return None


def _anew(file: Path, *options: str) -> str:
    """The command that makes a file of detections, for a message."""
    folder = file.parent if file.parent.name else file.absolute().parent
    take = folder.with_name(f"{folder.name.removesuffix('-detect')}.toml")
    video = next((p for p in folder.glob(f"{escape(file.stem.removesuffix('-detect'))}.*") if p.suffix != ".npz"), None)
    return command("detect", take if take.is_file() else video or "VIDEO", *options)


def _load(file: Path, *names: str) -> dict[str, NDArray]:
    """Arrays of these names, default all, of a complete file of this format and version."""
    wanted = {*names, "format", "version"} if names else ()
    try:
        arrays = read_npz(file, *wanted, remedy="")
    except FileError as error:
        raise ValueError(error.problem) from error
    if "format" not in arrays or str(arrays["format"]) != FORMAT:
        raise ValueError("another format")
    if arrays["version"].shape or int(arrays["version"]) != VERSION:
        raise FileError(
            f"detections of version {arrays['version']}; this kinefit reads version {VERSION}", file=file,
            remedy=f"Use the kinefit that wrote it, or a newer one; or detect again: {_anew(file, '--force')}",
        )
    return arrays
