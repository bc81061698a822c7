"""The balancing trial by silhouettes alone: masks as given, the product's own, and a camera held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, NotMeasured, amount, figure, quick, recording
from benchmarks.scenes.balancing import CAMERAS, masks_of, trial_text
from benchmarks.scenes.takes import tracked
from kinefit.bodies import BodyState
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import render_body, scaled
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteVideo

FRAMES = amount(100, 6)
SCALE = 0.25  # at which the body and masks are compared


def take_text(folder: Path, kind: str, cameras: Sequence[str] = CAMERAS, keypoints: str = "frames = [0, 1]\n") -> str:
    """The trial with silhouettes of some cameras, masks or a background's, and keypoints of its first frame."""
    plate = '[[silhouette]]\ncamera = "{1}"\nformat = "background"\nfile = "{0}/background_plate_{1}.png"\n'
    beside = {c: masks_of(folder, c) if kind == "masks" else plate.format(folder, c) for c in cameras}
    return trial_text(folder, beside, head=f"height = 1.75\nframes = [0, {FRAMES}]\n", keypoints=keypoints)


def overlaps(motion: Motion, rig: Rig, masks: Sequence[SilhouetteVideo]) -> NDArray:
    """(F, C) intersection over union of the projected body and the masks."""
    mesh = body_mesh(motion.body)
    out = np.empty((len(motion), len(masks)))
    for i in range(len(motion)):
        state = BodyState(motion.Ts_world_root[i], motion.angles[i])
        for c, video in enumerate(masks):
            camera = scaled(rig[video.sensor], SCALE)
            seen = render_body(motion.body, state, camera, mesh=mesh).seen
            out[i, c] = overlap(seen, video.frame(i).mask)
    return out


def overlap(seen: NDArray, mask: NDArray) -> float:
    """Intersection over union of an image (h, w) bool and a mask (H, W), 255 on the body, at the image's size."""
    own = cv2.resize(mask, seen.shape[::-1], interpolation=cv2.INTER_AREA) > 127
    return float((seen & own).sum() / max((seen | own).sum(), 1))


def run() -> None:
    """Print the overlap of the fitted body and the given masks."""
    folder = recording("video_balancing_4cam")
    motion, seen = tracked(take_text(folder, "masks"))
    masks = seen.of_kind("silhouette")
    given = overlaps(motion, seen.rig, masks)
    figure("masks as given: mean IoU of 400 images", given.mean(), "", ">= 0.88")
    print(f"  camera by camera {np.round(given.mean(axis=0), 3)}, worst image {given.min():.3f}")
    lost = (given.mean(axis=1) < 0.8).sum()
    figure("masks as given: frames tracked", float(len(motion) - lost), "frames", f"== {FRAMES}")
    if quick():
        raise NotMeasured(LEFT_OUT)
    own = overlaps(tracked(take_text(folder, "background"))[0], seen.rig, masks)
    figure("own masks from plates: mean IoU of 400 images", own.mean(), "", ">= 0.88")
    print(f"  camera by camera {np.round(own.mean(axis=0), 3)}, worst image {own.min():.3f}")
    held = []
    for k, camera in enumerate(CAMERAS):
        motion = tracked(take_text(folder, "masks", [c for c in CAMERAS if c != camera]))[0]
        held.append(overlaps(motion, seen.rig, masks[k : k + 1]).mean())
        print(f"  {camera} held out: {held[-1]:.3f}")
    figure("camera held out: mean IoU of its images", float(np.mean(held)), "", ">= 0.85")
