"""Face and hands by the colour of the skin in fits of a real take, held against a camera left out (P2-7).

    python -m benchmarks depth skin_takes

A seated person gestures before four webcams (60 frames). Each of the cameras 1 to 3 is left out in turn. Printed is how
far the network's wrists and hands in that camera are from where the fit to the other cameras has them. Fits are
takes of the command: by the network's keypoints of three cameras, of two, and of two with `format = "skin"` in the
third camera, in which then no network is asked for anything but the face of the first image.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data, figure
from benchmarks.scenes.held_out import persons, sides_right
from kinefit import Keypoints, Motion, Rig, TrackSettings, track_take
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.missing import prepared

CAMERAS = tuple(range(4))
SKIN = (1, 2, 3)  # camera 0 is so near that a hand hides the face
_HANDS = re.compile(r"(wrist|pinky|index|thumb)", re.IGNORECASE)
_FEET = re.compile(r"foot", re.IGNORECASE)
_MIN_CONFIDENCE = 0.6  # of the network's keypoints that are held against a fit: below it hands are guessed
WAYS = ("three cameras", "two cameras", "two cameras and skin in the third", "three cameras and skin in these")


def run() -> None:
    """Print the figures."""
    folder = data("mv4_upperbody_caliscope")
    found: dict[str, float] | None = None
    if folder is not None:
        with tempfile.TemporaryDirectory() as where:
            found = held_out(folder, Path(where))
            for way, px in found.items():
                print(f"network's keypoints of {way}: hands in the camera left out {px:.2f} px", flush=True)
    gain, more = None, None
    if found:
        two, third, three = found[WAYS[1]], found[WAYS[2]], found[WAYS[0]]
        gain, more = third / two, found[WAYS[3]] / three
    reason = "" if found else "no recording"
    unit = "times the px of hands in a camera left out"
    figure("skin_third_camera", gain, f"{unit}, skin in a third camera to two with keypoints", "<= 1", reason)
    figure("skin_beside_network", more, f"{unit}, skin beside keypoints of the same three cameras", "<= 1", reason)


def held_out(folder: Path, where: Path) -> dict[str, float]:
    """{way: median distance [px]} of the network's hands from each fit, over all cameras left out."""
    file = where / "take.toml"  # all takes have one name, and so one folder of detections
    file.write_text(_text(folder, CAMERAS, CAMERAS, ()))
    seen = load_observations(prepared(read_take(file)))
    assert seen.rig is not None
    judges = {one.camera: one for one in persons(seen.rig, seen.keypoints)}
    off: dict[str, list[NDArray]] = {way: [] for way in WAYS}
    for left_out in SKIN[: amount(3, 1)]:
        used = [c for c in CAMERAS if c != left_out]
        third = max(c for c in SKIN if c != left_out)
        two, skin = [c for c in used if c != third], [c for c in used if c in SKIN]
        for way, (network, colour) in zip(WAYS, ((used, ()), (two, ()), (two, (third,)), (used, skin))):
            file.write_text(_text(folder, used, network, colour))
            motion, _ = track_take(read_take(file), settings=TrackSettings(view_bias=False))
            off[way].append(_hands_off(motion, seen.rig, judges[f"cam_{left_out}"]))
            print(f"#   camera {left_out} left out, {way}: {np.median(off[way][-1]):.2f} px", flush=True)
    return {way: float(np.median(np.concatenate(parts))) for way, parts in off.items()}


def _text(folder: Path, used: Sequence[int], network: Sequence[int], colour: Sequence[int]) -> str:
    """A take of some cameras, some with the network's keypoints, some with face and hands by colour."""
    text = f'[take]\nrate = 6.0\nframes = [0, {amount(60, 6)}]\n'
    text += f'[calibration]\nfile = "{folder}/config.toml"\nunit = "m"\n'
    text += "".join(f'[[camera]]\nname = "cam_{c}"\nvideo = "{folder}/port_{c}.mp4"\n' for c in used)
    for format, cameras in (("detect", network), ("skin", colour)):
        text += "".join(f'[[keypoints]]\ncamera = "cam_{c}"\nformat = "{format}"\n' for c in cameras)
    return text


def _hands_off(motion: Motion, rig: Rig, judge: Keypoints) -> NDArray:
    """(N,) [px] of a camera's wrists and fingers, where the network sees them, from where a motion has them."""
    channels, fitted = sides_right(motion, rig.select((judge.camera,)), [judge])
    hand = np.array([bool(_HANDS.search(n)) and not _FEET.search(n) for n in channels.points.names])
    size = np.array(rig[judge.camera].size)
    shown = (channels.confidence > _MIN_CONFIDENCE) & hand & ((channels.uv > 0) & (channels.uv < size)).all(axis=-1)
    return np.asarray(np.linalg.norm(channels.uv - fitted, axis=-1)[shown])
