"""The balancing trial (`video_balancing_4cam`, four cameras at 60 Hz) as a take file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

TRIAL = "video_balancing_4cam"
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
_KEYPOINTS = {
    "openpose": ("openpose_json/{}", 'set = "BODY_25B"\nframe = "calibration"\n'),
    "mediapipe": ("mediapipe_landmarks_{}.npy", 'format = "mediapipe"\nset = "MEDIAPIPE_33"\nframe = "video"\n'),
}


def trial_text(
    folder: Path,
    cameras: Iterable[str] | Mapping[str, str] = CAMERAS,
    *,
    detector: str = "openpose",
    head: str = "",
    keypoints: str = "",
) -> str:
    """The take file of some cameras with a detector's keypoints.

    Parameters
    ----------
    detector : "openpose", "mediapipe", or "" for no keypoints.
    cameras : names, or {name: tables of other sensors of that camera}.
    head : further lines of `[take]`.
    keypoints : further lines of each `[[keypoints]]`.
    """
    beside = cameras if isinstance(cameras, Mapping) else dict.fromkeys(cameras, "")
    file, format_lines = _KEYPOINTS.get(detector, ("", ""))
    text = f'[take]\nup = "z"\n{head}[calibration]\nfile = "{folder}/Calib_refined_static.toml"\nunit = "m"\n'
    for camera, sensors in beside.items():
        boxed = 'image = "letterboxed"\n' if camera in ("cam01", "cam02") else ""
        text += f'[[camera]]\nname = "{camera}"\nvideo = "{folder}/videos/{camera}.mp4"\n{boxed}'
        if file:
            text += f'[[keypoints]]\ncamera = "{camera}"\nfile = "{folder}/{file.format(camera)}"\n'
            text += f"{format_lines}{keypoints}"
        text += sensors
    return text


def masks_of(folder: Path, camera: str) -> str:
    """The table of the masks that the recording has."""
    return f'[[silhouette]]\ncamera = "{camera}"\nfile = "{folder}/person_masks/{camera}"\nframe = "video"\n'
