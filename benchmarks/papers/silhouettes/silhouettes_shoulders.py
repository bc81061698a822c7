"""Morphing on real images (P1 4): the balancing trial with shoulders that morph, and with the same ones held stiff.

Each camera is held out in turn; silhouettes of the three others, and keypoints of the first frame, give the motion. In
the camera that took no part, frame by frame: overlap of body and mask within 20 cm of the shoulder joints, and how far
apart their outlines are there. The gain is the stiff body's minus the morphing one's, with its standard error over
blocks of ten frames, since neighbouring frames err alike. Both bodies' half axes are fitted by the take itself. The
same again of raised arms alone: the frames in which an elbow is above its shoulder, within 20 cm of that shoulder.
"""

from __future__ import annotations

import tempfile
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.silhouettes_track import take_text
from benchmarks.figures import amount, figure, quick, recording
from benchmarks.scenes import takes
from benchmarks.scenes.balancing import CAMERAS
from kinefit.bodies import BodyState
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import Canvas, scaled
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteVideo

SCALE = 0.5  # at which the body and masks are compared
AROUND = 0.2  # [m] of a shoulder joint
BLOCK = 10  # frames
HELD = amount(CAMERAS, CAMERAS[:1])


class Shoulders(NamedTuple):
    """Within 20 cm of the shoulders, frame by frame (F,): overlap, and distance of the outlines [mm]."""

    overlap: NDArray
    distance: NDArray
    raised: NDArray  # the overlap about shoulders whose elbow is above them; NaN where none is


def tracked(text: str, body: str) -> Motion:
    """The motion of the trial with a body of this name, or of this text of a body file."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if "\n" in body:
            (work / "body.toml").write_text(body)
            body = str(work / "body.toml")
        if quick():  # the fit of the person takes most of the time
            text = text.replace("height = 1.75", "size = false")
        return takes.tracked(text.replace("[take]\n", f'[take]\nbody = "{body}"\n', 1))[0]


def stiff(name: str = "humanoid_morphing") -> str:
    """The catalogue's body without its morphs, as the text of a body file."""
    text = (files("kinefit.bodies.toml") / "catalogue" / f"{name}.toml").read_text()
    return text[: text.index("[[morph]]")]


def shoulders(motion: Motion, rig: Rig, masks: SilhouetteVideo) -> Shoulders:
    """How well the body lies on the masks of one camera around its shoulders."""
    model, camera = Morphing(motion.body), scaled(rig[masks.sensor], SCALE)
    canvas, points = Canvas(camera.size), motion.body.landmarks.select(("r_shoulder", "l_shoulder"))
    elbows = motion.body.landmarks.select(("r_elbow", "l_elbow"))
    up = (1.0 if motion.up[0] != "-" else -1.0) * np.eye(3)["xyz".index(motion.up[-1])]
    out = np.full((3, len(motion)), np.nan)
    for i in range(len(motion)):
        pose = model.pose(BodyState(motion.Ts_world_root[i], motion.angles[i]))
        seen = canvas.draw_for(camera, pose.vertices, model.mesh.faces, cull=True).seen
        mask = cv2.resize(masks.frame(i).mask, camera.size, interpolation=cv2.INTER_AREA) > 127
        near, size, high = np.zeros(mask.shape, np.uint8), [], np.zeros(mask.shape, np.uint8)
        for x, elbow in zip(pose.positions(points), pose.positions(elbows)):
            z = camera.T_camera_world[2, :3] @ x + camera.T_camera_world[2, 3]
            size.append(z / camera.matrix[0, 0])
            u, v = np.rint(camera.project(x[None])[0]).astype(int)
            for field in [near, high] if (elbow - x) @ up > 0.0 else [near]:
                cv2.circle(field, (int(u), int(v)), int(AROUND / size[-1]), 1, -1)
        here, there = near > 0, high > 0
        edge = (cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0) & here
        out[0, i] = (seen & mask & here).sum() / max(((seen | mask) & here).sum(), 1)
        out[1, i] = 1e3 * float(np.mean(size)) * ((seen ^ mask) & here).sum() / max(edge.sum(), 1)
        if there.any():
            out[2, i] = (seen & mask & there).sum() / max(((seen | mask) & there).sum(), 1)
    return Shoulders(*out)


def gain(with_morphs: NDArray, without: NDArray) -> tuple[float, float]:
    """Mean of a difference (C, F) frame by frame, and its standard error over blocks of frames; NaN does not count."""
    rows = [row[np.isfinite(row)] for row in with_morphs - without]
    blocks = [b.mean() for row in rows if len(row) for b in np.array_split(row, max(len(row) // BLOCK, 1))]
    return float(np.mean(blocks)), float(np.std(blocks, ddof=1) / np.sqrt(len(blocks))) if len(blocks) > 1 else np.nan


def run() -> None:
    """Print the figures."""
    folder = recording("video_balancing_4cam")
    names = "morphing_real_overlap_gain", "morphing_real_outline_gain", "morphing_real_raised_gain"
    seen = takes.seen_of(take_text(folder, "masks"))
    assert seen.rig is not None
    found: dict[str, list[Shoulders]] = {"morphing": [], "stiff": []}
    for k, camera in enumerate(CAMERAS):
        if camera not in HELD:
            continue
        text = take_text(folder, "masks", [c for c in CAMERAS if c != camera])
        for name, body in (("morphing", "humanoid_morphing"), ("stiff", stiff())):
            found[name].append(shoulders(tracked(text, body), seen.rig, seen.of_kind("silhouette")[k]))
        a, b = (found[name][-1] for name in found)
        print(f"#   {camera} held out, around the shoulders, morphing and stiff: overlap {a.overlap.mean():.4f} and "
              f"{b.overlap.mean():.4f}, outlines {a.distance.mean():.1f} and {b.distance.mean():.1f} mm; arms raised "
              f"in {np.isfinite(a.raised).sum()} and {np.isfinite(b.raised).sum()} frames: overlap "
              f"{np.nanmean(a.raised):.4f} and {np.nanmean(b.raised):.4f}", flush=True)
        figure(f"morphing_real_gain_{camera}", float((a.overlap - b.overlap).mean()), "of 1", "> 0")
    a, b = ([np.array([getattr(s, field) for s in found[name]]) for field in Shoulders._fields] for name in found)
    for name, sign, own, other, unit in ((names[0], 1.0, a[0], b[0], "of 1"), (names[1], -1.0, a[1], b[1], "mm"),
                                         (names[2], 1.0, a[2], b[2], "of 1")):  # fmt: skip
        mean, error = gain(sign * own, sign * other)
        figure(name, mean, f"{unit}, standard error {error:.4f}", "> 0")
