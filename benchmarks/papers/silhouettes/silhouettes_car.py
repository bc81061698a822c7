"""A toy car on a turntable, tracked rigidly by silhouettes alone: a free-form surface of Fourier series (P1 2.4)."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import amount, figure
from benchmarks.scenes.silhouettes_scene import looking
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.fourier import FourierSurface
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.bodies.tree import KinematicTree
from kinefit.fitting.initialization.candidates import Level, coarse_to_fine
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteFrame
from kinefit.readers.calibration.read import write_calibration
from kinefit.sensors.settings import TrackSettings
from kinefit.takes.track import track_take

BODY = """
[body]
name = "car"
[[segment]]
name = "car"
joint = { name = "free", type = "free" }
surface = { mesh = "car.obj" }
[landmarks]
front = { segment = "car", at = [0.15, 0.03, 0.0] }
"""
FRAMES = 120  # three degrees a frame
SEEN = amount(FRAMES, 30)
LENGTH = 0.3  # [m]
OFF = amount((10, 20, 30, 40, 60), (10, 40))  # [deg] from which the car is found ...
TRIALS = amount(6, 1)  # ... and how often that is tried
# Reach of a correspondence in the size of a car, not of a person.
SETTINGS = TrackSettings(search=False, outline=640, far=0.03, near=0.005, patch=0.01, reach=0.05, iterations=12)


def surface() -> FourierSurface:
    """A car's free-form surface about 30 cm long; z is across."""
    profile = np.array([
        (-1, 0.12), (-0.97, 0.42), (-0.72, 0.5), (-0.5, 0.86), (-0.1, 0.95), (0.18, 0.88), (0.42, 0.55), (0.85, 0.44),
        (1, 0.28), (1, 0.1), (0.5, 0.08), (0, 0.08), (-0.5, 0.08),
    ])  # fmt: skip
    ends = np.vstack([profile, profile[:1]])
    along = np.linspace(0, len(profile), 96, endpoint=False)
    x, y = (np.interp(along, np.arange(len(ends)), ends[:, k]) for k in (0, 1))
    across = np.linspace(-1, 1, 41)
    shrink = np.sqrt(np.clip(1 - 0.98 * np.abs(across) ** 6, 0, 1))  # rounded sides
    roof = np.where(y > 0.5, 1.0 - 0.3 * (y - 0.5), 1.0)  # the cabin is narrower than the body
    middle = np.array([x.mean(), y.mean()])
    half = 0.5 * LENGTH
    grid = np.stack([
        half * (middle[0] + shrink * (x[:, None] - middle[0])),
        half * 0.6 * (middle[1] + shrink * (y[:, None] - middle[1])),
        half * 0.42 * across * roof[:, None],
    ], axis=-1)  # fmt: skip
    return FourierSurface.of(grid, closed=(True, False), orders=(16, 12))


def car(shape: FourierSurface) -> Body:
    """One segment that moves freely, with a free-form surface."""
    half = 0.5 * LENGTH
    vertices, faces = shape.triangles((128, 48))
    none = np.zeros(0)
    tree = KinematicTree(
        ("car",), np.array([-1]), np.zeros((1, 3)), (), none, np.zeros((0, 3)), none, none, none, none, none
    )
    corners = PointSet(("front", "back", "left", "right"), np.zeros(4, int), half * np.array(
        [(1.0, 0.2, 0), (-1.0, 0.2, 0), (0, 0.2, -0.42), (0, 0.2, 0.42)]))  # fmt: skip
    mesh = MeshSurface(0, vertices, faces, series=shape, nodes=(128, 48))
    return Body("car", tree, ("free",), ("whole",), np.zeros(1, int), corners, surfaces=(mesh,))


def placed(turn: float) -> BodyState:
    """The car on its table, turned [rad] about the vertical, its axis 5 cm beside its middle."""
    T = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = T[:3, :3] @ (0.05, 0.0, 0.02)
    return BodyState(T, np.zeros(0))


def run() -> None:
    """Print how far the car is off over a whole turn."""
    whole = surface()
    body = car(whole)
    middle = np.array([0.0, 0.05, 0.0])
    views = [("front", (0.0, 0.45, 0.9)), ("side", (0.85, 0.35, 0.4))]
    rig = Rig(tuple(looking(name, np.array(eye), middle, (640, 480), 900.0) for name, eye in views))
    accuracy = {f"silhouette {name}": 0.5 for name in rig.names}
    motion = _by_take(body, rig)
    turns, shifts = [], []
    for i in range(SEEN):
        truth, T = placed(2 * np.pi * i / FRAMES).T_world_root, motion.Ts_world_root[i]
        turns.append(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3].T @ truth[:3, :3]) - 1) / 2, -1, 1))))
        shifts.append(1e3 * np.linalg.norm(T[:3, 3] - truth[:3, 3]))
    print(f"# two cameras 1 m away; {len(body.surfaces[0].faces)} triangles; worst frame "  # type: ignore[union-attr]
          f"{max(turns[3:]):.2f} degrees, {max(shifts[3:]):.2f} mm")  # fmt: skip
    figure("car on a turntable: angle off, mean over 360 degrees", float(np.mean(turns)), "deg", "<= 1")
    figure("car on a turntable: place off, mean over 360 degrees", float(np.mean(shifts)), "mm", "<= 2")
    _basin(whole, rig, accuracy)


def _by_take(body: Body, rig: Rig) -> Motion:
    """As `kinefit track` has it with its defaults: masks, a mesh, and a start that is 4 degrees off."""
    T = placed(np.radians(-4.0)).T_world_root
    mesh = body.surfaces[0]
    assert isinstance(mesh, MeshSurface)
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*v) for v in mesh.vertices]
    lines += ["f {} {} {}".format(*f) for f in mesh.faces + 1]
    listed = lambda values: "[" + ", ".join(f"{v:.6f}" for v in values) + "]"
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        (folder / "car.obj").write_text("\n".join(lines), encoding="utf-8")
        (folder / "car.toml").write_text(BODY, encoding="utf-8")
        write_calibration(rig, folder / "calibration.toml")
        text = f'[take]\nrate = 25.0\nup = "y"\nbody = "car.toml"\nsize = false\n[start]\nat = {listed(T[:3, 3])}\n'
        text += f'forward = {listed(T[:3, 0])}\nupward = {listed(T[:3, 1])}\n[calibration]\nfile = "calibration.toml"\n'
        for camera in rig:
            (folder / camera.name).mkdir()
            for i in range(SEEN):  # drawn at twice the size, so that a pixel of a mask knows its share
                mask = _seen(body, placed(2 * np.pi * i / FRAMES), rig, camera.name, i).mask
                cv2.imwrite(str(folder / camera.name / f"{i:04d}.png"), mask)
            text += f'[[camera]]\nname = "{camera.name}"\nsize = [640, 480]\n[[silhouette]]\ncamera = "{camera.name}"\n'
            text += f'file = "{camera.name}"\nrate = 25.0\nsigma = 0.5\n'
        (folder / "take.toml").write_text(text, encoding="utf-8")
        return track_take(folder / "take.toml")[0]


def _basin(whole: FourierSurface, rig: Rig, accuracy: dict[str, float]) -> None:
    """From how far turned the car is found: the whole surface alone, and from low frequencies to all of them."""
    fine = Level(640, 0.03, 0.005, 1.0)
    levels = (Level(80, 0.12, 0.04, 1.4), Level(160, 0.06, 0.02, 1.2), fine)
    body = car(whole)
    kinds = {
        "finest level alone": ([fine], False),
        "image coarse to fine": (levels, False),
        "Fourier coarse to fine": ([level._replace(side=640) for level in levels], True),
        "image and Fourier coarse to fine": (levels, True),
    }
    share = {kind: np.zeros(len(OFF)) for kind in kinds}
    for k, off in enumerate(OFF):
        rng = np.random.default_rng(k)
        for turn in rng.uniform(0, 2 * np.pi, TRIALS):
            seen = [_seen(body, placed(turn), rig, name, 0) for name in rig.names]
            start = placed(turn + np.radians(off) * rng.choice([-1, 1]))
            for kind, (steps, low_pass) in kinds.items():
                found = coarse_to_fine(
                    body, rig, seen, start, sigma=accuracy, levels=steps, low_pass=low_pass, settings=SETTINGS
                ).result.state
                R = found.T_world_root[:3, :3].T @ placed(turn).T_world_root[:3, :3]
                share[kind][k] += (np.trace(R) > 1 + 2 * np.cos(np.radians(2.0))) / TRIALS
        print(f"# turned by {off} degrees: " + ", ".join(f"{kind} {100 * s[k]:.0f} %" for kind, s in share.items()))
    alone = share["finest level alone"]
    for name, more in list(share.items())[1:]:
        figure(f"car: starts found that {name} adds", 100 * float((more - alone).mean()), "%", ">= 10")


def _seen(body: Body, state: BodyState, rig: Rig, name: str, i: int) -> SilhouetteFrame:
    camera = rig[name]
    large = replace(camera, size=(2 * camera.size[0], 2 * camera.size[1]),
                    matrix=camera.scaled((2 * camera.size[0], 2 * camera.size[1])).matrix)  # fmt: skip
    fine = render_body(body, state, large).seen.reshape(camera.size[1], 2, camera.size[0], 2).mean(axis=(1, 3))
    return SilhouetteFrame(name, i / 25.0, np.rint(255 * fine).astype(np.uint8))
