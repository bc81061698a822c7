"""The balancing trial by the colours of its videos: no masks, no background plate, keypoints of its first frame alone.

Masks are looked at to compare with only. Settings (by which lines agree, how colours are counted by parts of the body)
were chosen on this very trial, the only real one of a whole person: it is not held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.accuracy.images.silhouettes_track import overlaps
from benchmarks.accuracy.images.silhouettes_track import take_text as masks_text
from benchmarks.accuracy.mixed import mixed_real
from benchmarks.figures import LEFT_OUT, NotMeasured, amount, figure, quick, recording
from benchmarks.scenes.balancing import CAMERAS, trial_text
from benchmarks.scenes.takes import seen_of, tracked
from kinefit.fitting.multiview.association import choose_people
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteVideo

FRAMES = amount(100, 3)
TRACKED = amount(CAMERAS, CAMERAS[:2])
GOOD = 0.8  # overlap of a frame from which it counts as tracked, as of silhouettes
GOALS = {
    "regions alone: mean IoU of 400 images": ">= 0.85",
    "regions alone: frames tracked": f"== {FRAMES}",
    "regions alone, a camera held out: mean IoU of its images": ">= 0.82",
    "keypoints and regions: residual of keypoints, over keypoints alone": "<= 1.05",
    "keypoints and regions: IoU less that of keypoints alone": ">= 0",
}


def take_text(folder: Path, cameras: Sequence[str] = CAMERAS, *, regions: bool = True, first: bool = True) -> str:
    """The trial with the colours of some cameras, and with keypoints of its first frame, or of all."""
    beside = {camera: f'[[region]]\ncamera = "{camera}"\n' if regions else "" for camera in cameras}
    head = f"height = 1.75\nframes = [0, {FRAMES}]\n"
    return trial_text(folder, beside, head=head, keypoints="frames = [0, 1]\n" if first else "")


def run() -> None:
    """Print how well the projected body overlaps the masks, and what regions change beside keypoints."""
    folder = recording("video_balancing_4cam")
    names = list(GOALS)
    masks = seen_of(masks_text(folder, "masks"))
    rig = masks.rig
    assert rig is not None
    motion = tracked(take_text(folder, TRACKED))[0]
    alone = overlaps(motion, rig, masks.silhouettes)
    figure(names[0], alone.mean(), "", GOALS[names[0]])
    print(f"  camera by camera {np.round(alone.mean(axis=0), 3)}, worst image {alone.min():.3f}; "
          f"lowest quality {motion.quality.min():.2f}")  # fmt: skip
    figure(names[1], float((alone.mean(axis=1) >= GOOD).sum()), "frames", GOALS[names[1]])
    if quick():
        raise NotMeasured(LEFT_OUT)
    held = []
    for k, camera in enumerate(CAMERAS):
        of = tracked(take_text(folder, [c for c in CAMERAS if c != camera]))[0]
        held.append(overlaps(of, rig, masks.silhouettes[k : k + 1]).mean())
        print(f"  {camera} held out: {held[-1]:.3f}", flush=True)
    figure(names[2], float(np.mean(held)), "", GOALS[names[2]])
    _beside_keypoints(folder, rig, masks.silhouettes)


def _beside_keypoints(folder: Path, rig: Rig, masks: Sequence[SilhouetteVideo]) -> None:
    seen = seen_of(take_text(folder, first=False))
    people = choose_people(rig, seen.keypoints)
    off, share = [], []
    for regions in (False, True):
        motion = tracked(take_text(folder, regions=regions, first=False))[0]
        off.append(float(np.nanmedian(mixed_real.residuals(motion, rig, seen.keypoints, people))))
        share.append(float(overlaps(motion, rig, masks).mean()))
    names = list(GOALS)
    figure(names[3], off[1] / off[0], "x", GOALS[names[3]])
    figure(names[4], share[1] - share[0], "", GOALS[names[4]])
    print(f"  keypoints alone {off[0]:.2f} px, IoU {share[0]:.3f}; with regions {off[1]:.2f} px, {share[1]:.3f}")
