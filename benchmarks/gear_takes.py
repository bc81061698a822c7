"""Rendered takes of a cyclist and a snowboarder, written as a user would have them: videos, calibration, take file.

Keypoints are of the first frame alone. Cameras are written as a calibration has them, off by what it is taken to be.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from benchmarks import gear_things as draw
from benchmarks.closures_takes import RATE, SET, calibrated, cyclist, snowboarder
from benchmarks.figures import amount
from benchmarks.gear_scene import GearScene, Light, Thing, clouds
from benchmarks.gear_things import box, piece
from kinefit.bodies import load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.toml.bodies import catalogue_text
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation import movement, simulate_keypoints, studio_rig
from kinefit.simulation.retarget import known_motion

SIZE, FOCAL = (640, 480), 600.0
SECONDS = 1.0
VIDEOS = amount(4, 2)
_NOISE, _DRIFT = 1.5, 1.0  # [px] of the keypoints of the first frame
_CASE = np.array([[-0.40, -0.30, -0.42], [0.42, 0.70, -0.015]])  # [m] in the bike's frame: around the left leg


@dataclass(frozen=True, eq=False)
class GearTake:
    """A rendered take.

    Parameters
    ----------
    name : "cyclist" or "snowboarder"
    truth : Motion, of the person's own body
    scene : GearScene
    hidden : (F,) bool, frames in which the left leg is behind a cover
    seed : int
    videos : int, of the cameras, whose colours are used; the others have the keypoints of the first frame alone
    without : names of closures that the body is tracked without
    """

    name: str
    truth: Motion
    scene: GearScene
    hidden: NDArray
    seed: int
    videos: int
    without: tuple[str, ...] = ()

    def write(self, folder: Path, *, closures: bool) -> Path:
        """The take file, with a body file that holds closures or does not; videos are written once."""
        folder.mkdir(parents=True, exist_ok=True)
        rig = self.scene.rig
        (folder / f"{self.name}_{closures}.toml").write_text(body_text(self.name, closures, self.without))
        take = folder / f"take_{closures}.toml"
        take.write_text(_take(self, f"{self.name}_{closures}.toml"))
        if not (folder / "calibration.toml").exists():
            for camera in rig.cameras[: self.videos]:
                _video(self.scene, camera, folder / f"{camera.name}.mp4", self.truth.rate)
            seen = simulate_keypoints(
                self.truth, rig, SET, noise_px=_NOISE, drift_px=_DRIFT, outliers=0.03, missing=0.05, seed=self.seed
            )
            for k in seen:
                _keypoints(k, folder / k.camera)
            write_calibration(calibrated(rig, self.seed), folder / "calibration.toml")
        return take


def body_text(name: str, closures: bool, without: Sequence[str] = ()) -> str:
    """The catalogue's body file without surfaces of gear, which no sensor then looks for; and without closures."""
    text, out, inside = catalogue_text(name), [], False
    for one in without:
        before, after = text.split(f'[[closure]]\nname = "{one}"\n')
        text = before + after[after.index("\n[") + 1 :]
    for line in (text if closures else text.split("[[closure]]")[0]).splitlines():
        starts = line.startswith("surface = ")
        inside = (inside or starts) and not (line == "]" or (starts and not line.endswith("[")))
        if not (starts or inside or line == "]"):
            out.append(line)
    return "\n".join(out) + "\n"


def _take(take: GearTake, body: str) -> str:
    text = f'[take]\nup = "y"\nrate = {take.truth.rate}\nbody = "{body}"\nheight = {take.truth.body.stature:.2f}\n'
    text += '[calibration]\nfile = "calibration.toml"\n'
    for k, name in enumerate(take.scene.rig.names):
        text += f'[[camera]]\nname = "{name}"\n'
        text += f'video = "{name}.mp4"\n[[region]]\ncamera = "{name}"\n' if k < take.videos else ""
        text += f'[[keypoints]]\ncamera = "{name}"\nfile = "{name}"\nset = "{SET}"\n'
        text += f"rate = {take.truth.rate}\nframes = [0, 1]\n"
    return text


def _video(scene: GearScene, camera, path: Path, rate: float) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(rate), options={"crf": "16", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = *camera.size, "yuv420p"
        for image in scene.images(camera):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _keypoints(seen, folder: Path) -> None:
    """As OpenPose writes them; nobody in all frames but the first."""
    folder.mkdir(exist_ok=True)
    for f in range(len(seen.points)):
        points = np.nan_to_num(np.column_stack([seen.points[0, 0], seen.confidence[0, 0]]))
        people = [{"pose_keypoints_2d": np.round(points, 3).ravel().tolist()}] if f == 0 else []
        (folder / f"{f:06d}_keypoints.json").write_text(json.dumps({"people": people}))


def rendered_cyclist(
    seed: int, *, cover: bool = False, seconds: float = SECONDS, videos: int = VIDEOS, shutter: float = 0.0,
    cameras: int = 4, rate: float = RATE, size: float = 1.0, rise: tuple[float, float] | None = None,
) -> GearTake:  # fmt: skip
    """In a lab, four cameras; the bike stands in view. The cover comes up before the left leg after a fifth.

    The shutter is open for a part of the time between two images, which blurs what moves. Images are `size` times
    640 × 480 px. A rider who rises from the saddle between two times [s] is tracked without its closure.
    """
    truth = cyclist(seed, seconds=amount(seconds, 0.12), rate=rate, rise=rise).truth
    random, count = np.random.default_rng((seed, 50)), len(truth)
    rig = _rig(truth, cameras, size)
    moving, hidden = draw.dressed(truth, random), np.zeros(count, bool)
    moving = draw.painted(moving, truth.body, "bike", (0.7, 0.1, 0.1))
    if cover:
        first = count // 5
        hidden[first + 10 :] = True
        T = np.repeat(truth.segment_poses()[0, truth.body.tree.segment("bike")][None], count, axis=0)
        T[:, 1, 3] -= 1.1 * np.clip(1.0 - (np.arange(count) - first) / 10.0, 0.0, 1.0)
        moving = draw.together(moving, piece(*box(*_CASE), np.array([0.45, 0.5, 0.55]), T))
    centre = moving.posed(0).mean(axis=0) * (1, 0, 1)
    away = max(float(np.linalg.norm((c.centre_world - centre)[[0, 2]])) for c in rig)
    things = [*draw.bike_stands(truth), *draw.scattered(random, centre, 1.3, away + 0.8, 26, seed)]
    light = Light(_unit(0.3, 1.0, 0.2), np.array([0.65, 0.63, 0.6]), np.array([0.42, 0.43, 0.45]), np.ones(count),
                  np.full((count, len(rig)), 0.95))  # fmt: skip
    ground = draw.lab_ground(centre, away + 1.2, seed)
    scene = _scene(moving, things, rig, light, ground, shutter, seed, centre)
    return GearTake("cyclist", truth, scene, hidden, seed, min(videos, cameras), ("seat",) if rise else ())


def rendered_snowboarder(
    seed: int, *, cover: bool = False, seconds: float = SECONDS, cameras: int = 7, rate: float = RATE,
    size: float = 1.0, about_jump: bool = False,
) -> GearTake:  # fmt: skip
    """Outdoors, seven cameras, clouds, a second person; the cover, of spray, is about the left shank and boot."""
    truth = snowboarder(seed, seconds=amount(seconds, 0.2), rate=rate, about_jump=about_jump).truth
    random, count = np.random.default_rng((seed, 51)), len(truth)
    rig = _rig(truth, cameras, size)
    moving, hidden = draw.dressed(truth, random), np.zeros(count, bool)
    moving = draw.painted(moving, truth.body, "board", random.uniform(0.1, 0.9, 3))
    centre = moving.posed(count // 2).mean(axis=0) * (1, 0, 1)
    walker = _walker(centre, count, random, rate)
    parts = [moving, draw.dressed(walker, random)]
    if cover:
        hidden[count // 5 :] = True
        parts.append(_spray(truth, hidden))
    moving = draw.together(*parts)
    light = Light(_unit(*random.uniform((-0.8, 0.6, -0.8), (0.8, 0.9, 0.8))), np.array([1.0, 0.94, 0.82]) * 0.75,
                  np.array([0.27, 0.31, 0.38]), *clouds(count, rate, len(rig), random))  # fmt: skip
    things = draw.scattered(random, centre, 2.6, 9.0, 30, seed)
    ground = draw.slope_ground(centre, 16.0, seed)
    scene = _scene(moving, things, rig, light, ground, 0.5, seed, centre)
    return GearTake("snowboarder", truth, scene, hidden, seed, len(rig))


def _scene(
    moving: Thing, things: list[Thing], rig, light: Light, ground, shutter: float, seed: int, centre: NDArray
) -> GearScene:
    """With those things that stand in no camera's way to the middle."""
    clear = []
    for thing in things:
        x = thing.posed(0).mean(axis=0)
        for camera in rig:
            way = (centre - camera.centre_world)[[0, 2]]
            far = float(np.linalg.norm(way))
            s = float((x - camera.centre_world)[[0, 2]] @ way) / far
            beside = np.linalg.norm((x - camera.centre_world)[[0, 2]] - s * way / far)
            if -0.5 < s < far - 1.2 and beside < 0.5 + 0.25 * max(s, 0.0):
                break
        else:
            clear.append(thing)
    return GearScene(moving, draw.together(*clear), rig, light, ground, shutter, seed)


def _unit(*v: float) -> NDArray:
    return np.array(v) / np.linalg.norm(v)


def _rig(truth: Motion, cameras: int, size: float) -> Rig:
    return studio_rig(
        truth, cameras=cameras, up="y", size=(int(size * SIZE[0]), int(size * SIZE[1])), focal=size * FOCAL
    )


def _walker(centre: NDArray, count: int, random: np.random.Generator, rate: float) -> Motion:
    """Somebody else, who walks by two metres away."""
    walk = movement("walk", load_body("humanoid"), rate=rate)
    turn, away = random.uniform(0.0, 2.0 * np.pi), random.uniform(1.7, 2.3)
    T = se3.transform(se3.exp_so3(np.array([0.0, turn, 0.0])), np.zeros(3))
    part = slice(round(0.8 * rate), round(0.8 * rate) + count)
    Ts = T @ walk.Ts_world_root[part]
    middle = Ts[count // 2, :3, 3] * (1, 0, 1)
    Ts[:, :3, 3] += centre - middle + away * np.array([np.cos(turn + 2.0), 0.0, np.sin(turn + 2.0)])
    return known_motion(walk.body, rate, Ts, walk.angles[part])


def _spray(truth: Motion, hidden: NDArray) -> Thing:
    """Snow about the left shank and boot, below the ground while there is none."""
    poses, tree = truth.segment_poses(), truth.body.tree
    ankle, knee = (poses[:, tree.segment(name), :3, 3] for name in ("foot_l", "shank_l"))
    v, f = draw.tube((0, -0.52, 0), (0, 0.3, 0), (0.27, 0.17))
    T = np.array(poses[:, tree.segment("shank_l")])
    T[:, :3, 3] = 0.5 * (ankle + knee)
    T[~hidden, 1, 3] -= 50.0
    return replace(piece(v, f, np.array([0.9, 0.92, 0.95]), T), contrast=0.05)
