"""The balancing trial by silhouettes alone: masks as given, the product's own, and a camera held out."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, amount, data, figure, quick
from kinefit.bodies import BodyState
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import render_body, scaled
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteVideo
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.track import track_take

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
FRAMES = amount(100, 6)
SCALE = 0.25  # at which the body and masks are compared


def trial_text(folder: Path, beside: Mapping[str, str], keypoints: str) -> str:
    """The trial with keypoints and, camera by camera, other sensors beside; `keypoints` stands in their tables."""
    text = f'[take]\nup = "z"\nheight = 1.75\nframes = [0, {FRAMES}]\n'
    text += f'[calibration]\nfile = "{folder}/Calib_refined_static.toml"\nunit = "m"\n'
    for camera, sensors in beside.items():
        boxed = 'image = "letterboxed"\n' if camera in ("cam01", "cam02") else ""
        text += f'[[camera]]\nname = "{camera}"\nvideo = "{folder}/videos/{camera}.mp4"\n{boxed}'
        text += f'[[keypoints]]\ncamera = "{camera}"\nfile = "{folder}/openpose_json/{camera}"\n'
        text += f'set = "BODY_25B"\nframe = "calibration"\n{keypoints}{sensors}'
    return text


def take_text(folder: Path, kind: str, cameras: Sequence[str] = CAMERAS, keypoints: str = "frames = [0, 1]\n") -> str:
    """The trial with silhouettes of some cameras, and keypoints of its first frame."""
    masks = 'file = "{folder}/person_masks/{camera}"\nframe = "video"\n'
    plate = 'format = "background"\nfile = "{folder}/background_plate_{camera}.png"\n'
    own = masks if kind == "masks" else plate
    beside = {c: f'[[silhouette]]\ncamera = "{c}"\n{own.format(folder=folder, camera=c)}' for c in cameras}
    return trial_text(folder, beside, keypoints)


def tracked(text: str, *, contacts: bool = False) -> Motion:
    """The motion of a take; with soles held where they rest."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.toml"
        path.write_text(text)
        return track_take(path, contacts=contacts)[0]


def overlaps(motion: Motion, rig: Rig, masks: Sequence[SilhouetteVideo]) -> NDArray:
    """(F, C) intersection over union of the projected body and the masks."""
    mesh = body_mesh(motion.body)
    out = np.empty((len(motion), len(masks)))
    for i in range(len(motion)):
        state = BodyState(motion.Ts_world_root[i], motion.angles[i])
        for c, video in enumerate(masks):
            camera = scaled(rig[video.sensor], SCALE)
            seen = render_body(motion.body, state, camera, mesh=mesh).seen
            mask = cv2.resize(video.frame(i).mask, camera.size, interpolation=cv2.INTER_AREA) > 127
            out[i, c] = (seen & mask).sum() / max((seen | mask).sum(), 1)
    return out


def run() -> None:
    """Print the overlap of the fitted body and the given masks."""
    folder = data("video_balancing_4cam")
    goals = {
        "masks as given: mean IoU of 400 images": ">= 0.88",
        "masks as given: frames tracked": f"== {FRAMES}",
        "own masks from plates: mean IoU of 400 images": ">= 0.88",
        "camera held out: mean IoU of its images": ">= 0.85",
    }
    if folder is None:
        for name, goal in goals.items():
            figure(name, None, "", goal, "no recording video_balancing_4cam")
        return
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "take.toml"
        path.write_text(take_text(folder, "masks"))
        take = read_take(path)
        seen = load_observations(take)
        masks = seen.of_kind("silhouette")
    assert seen.rig is not None
    motion = tracked(take_text(folder, "masks"))
    given = overlaps(motion, seen.rig, masks)
    figure("masks as given: mean IoU of 400 images", given.mean(), "", ">= 0.88")
    print(f"  camera by camera {np.round(given.mean(axis=0), 3)}, worst image {given.min():.3f}")
    lost = (given.mean(axis=1) < 0.8).sum()
    figure("masks as given: frames tracked", float(len(motion) - lost), "frames", f"== {FRAMES}")
    if quick():
        figure("own masks from plates: mean IoU of 400 images", None, "", ">= 0.88", LEFT_OUT)
        figure("camera held out: mean IoU of its images", None, "", ">= 0.85", LEFT_OUT)
        return
    own = overlaps(tracked(take_text(folder, "background")), seen.rig, masks)
    figure("own masks from plates: mean IoU of 400 images", own.mean(), "", ">= 0.88")
    print(f"  camera by camera {np.round(own.mean(axis=0), 3)}, worst image {own.min():.3f}")
    held = []
    for k, camera in enumerate(CAMERAS):
        motion = tracked(take_text(folder, "masks", [c for c in CAMERAS if c != camera]))
        held.append(overlaps(motion, seen.rig, masks[k : k + 1]).mean())
        print(f"  {camera} held out: {held[-1]:.3f}")
    figure("camera held out: mean IoU of its images", float(np.mean(held)), "", ">= 0.85")
