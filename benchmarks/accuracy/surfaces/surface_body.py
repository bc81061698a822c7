"""A drawn textured arm through `kinefit surface` and `kinefit track`: joint angles against the truth.

The body is the catalogue's arm with exact lengths and girths, drawn with 64 corners around and a texture of 2 mm,
before three cameras of 640x640 px at 1.3 m, noise of 2 grey values, as motion JPEG. `[start]` is off by 4 to 5 degrees
in every angle. Its shoulder turns with the root, so that the upper arm's turns count as those of the segment in the
world. Seeds 10 and 11 were looked at in development; the figures are of 12 and 13.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import printed
from benchmarks.figures import amount, figure
from benchmarks.scenes.textured import textured_picture, write_video
from kinefit.bodies import BodyState, load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.motion import read_motion
from kinefit.simulation.figures import look_at
from kinefit.simulation.rendering.scenes import SimulatedScene

OFF = {"arm_flex_r": 4.0, "arm_add_r": -4.0, "arm_rot_r": 4.0, "elbow_flex_r": -4.0, "pro_sup_r": 5.0}  # [deg]


def run() -> None:
    """Print the figures."""
    worst: dict[str, list[float]] = {}
    for seed in (12, 13)[: amount(2, 1)]:
        with tempfile.TemporaryDirectory() as place:
            for name, rms in errors(Path(place), seed, frames=amount(40, 4), size=amount(640, 320)).items():
                worst.setdefault(name, []).append(rms)
    for name, values in worst.items():
        unit = "stated standard deviations, RMS" if name.endswith("deviations") else "deg RMS"
        figure(f"surface_body_{name}", max(values), unit, "<= 2")


def moving_arm(seed: int, frames: int) -> Motion:
    """A motion of the catalogue's arm at 30 Hz: all angles but the wrist's swing by 5 to 30 degrees."""
    body, rng, time = load_body("arm"), np.random.default_rng(seed), np.arange(frames) / 30.0
    names = body.tree.coordinates
    angles = np.tile(body.default_state().angles, (frames, 1))
    about = {"arm_flex_r": 20, "arm_add_r": -10, "arm_rot_r": 5, "elbow_flex_r": 60, "pro_sup_r": 55, "wrist_flex_r": 0}
    for name, middle in about.items():
        swing = rng.uniform(5, 15) if name != "elbow_flex_r" else rng.uniform(15, 30)
        wave = swing * np.sin(2 * np.pi * rng.uniform(0.3, 0.6) * time + rng.uniform(0, 6))
        angles[:, names.index(name)] = np.radians(middle + wave)
    n, one = len(body.tree.segments), np.ones
    return Motion(
        body=body, rate=30.0, times=time, Ts_world_root=np.tile(np.eye(4), (frames, 1, 1)), angles=angles,
        dof_std=one((frames, body.tree.n_dofs)), joint_std=one((frames, n, 3)), quality=one(frames),
        segment_quality=one((frames, n)), residuals={}, up="y", name="arm", provenance={},
    )  # fmt: skip


def cameras(size: int) -> Rig:
    """Three cameras beside each other that look at the arm from its side."""
    out, aim = [], np.array([0.2, -0.3, 0.0])
    for name, x in (("middle", 0.0), ("left", -0.2), ("right", 0.2)):
        place = np.array([0.2 + x, -0.2, 1.3])
        T = look_at(place, aim, np.array([0.0, 1.0, 0.0]))
        K = np.array([[1.6 * size, 0, size / 2], [0, 1.6 * size, size / 2], [0, 0, 1]])
        out.append(Camera(name, (size, size), K, np.zeros(4), "radtan", T))
    return Rig(tuple(out))


def record(folder: Path, motion: Motion, rig: Rig, seed: int) -> None:
    """Videos of the arm, the calibration, and a take that names what `kinefit surface` will write."""
    scene = SimulatedScene(motion, body_mesh(motion.body, around=64))
    write_calibration(rig, folder / "calib.toml")
    for camera in rig:
        grain = 0.0026 * 640 / camera.size[0]
        images = (textured_picture(scene, k, camera, grain=grain, seed=seed) for k in range(len(motion)))
        write_video(folder / f"{camera.name}.avi", images, motion.rate)
    start = {n: float(np.degrees(a)) for n, a in zip(motion.body.tree.coordinates, motion.angles[0])}
    told = ", ".join(f"{name} = {value + OFF.get(name, 0.0):.3f}" for name, value in start.items())
    (folder / "take.toml").write_text(
        f'[take]\nrate = {motion.rate}\nup = "y"\nbody = "arm"\nsize = false\n'
        f"[start]\nat = [0.0, 0.0, 0.0]\nforward = [1.0, 0.0, 0.0]\nangles = {{ {told} }}\n"
        '[[surface_points]]\nfile = "surface/trajectories.csv"\n'
    )


def errors(folder: Path, seed: int, *, frames: int, size: int) -> dict[str, float]:
    """RMS errors [deg] of the elbow's and wrist's angles, also without their means and in stated standard deviations,
    and of the upper arm's turn.
    """
    motion, rig = moving_arm(seed, frames), cameras(size)
    record(folder, motion, rig, seed)
    views = [f"{camera.name}={folder / camera.name}.avi" for camera in rig]
    printed("surface", folder / "calib.toml", *views, "-o", folder / "surface")
    printed("track", folder / "take.toml", "-o", folder / "result")
    print(f"  {len((folder / 'surface' / 'trajectories.csv').read_text().splitlines()) - 1} places of points")
    found = read_motion(folder / "result" / "motion.npz")
    names = motion.body.tree.coordinates
    off = np.degrees(found.angles - motion.angles[: len(found)])
    told_names = [name for name in names if "arm" not in name]
    out = {name: float(np.sqrt(np.mean(off[:, names.index(name)] ** 2))) for name in told_names}
    out |= {f"{name}_change": float(off[:, names.index(name)].std()) for name in told_names}
    std = np.degrees(found.dof_std[:, 6:])
    for name in told_names:
        d = names.index(name)
        print(f"  {name}: off {off[0, d]:.2f} to {off[-1, d]:.2f} deg, stated {std[0, d]:.2f} to {std[-1, d]:.2f} deg")
        out[f"{name}_deviations"] = float(np.sqrt(np.mean((off[:, d] / std[:, d]) ** 2)))
    turned = [_turn(a.state(k), b.state(k), motion) for a, b, k in ((found, motion, k) for k in range(len(found)))]
    return {"upperarm": float(np.sqrt(np.mean(np.square(turned)))), **out}


def _turn(a: BodyState, b: BodyState, motion: Motion) -> float:
    """[deg] between the upper arms of two states."""
    k = motion.body.tree.segments.index("upperarm_r")
    R = [frames_of(motion, s)[k, :9].reshape(3, 3) for s in (a, b)]
    return float(np.degrees(np.linalg.norm(se3.log_so3(R[0] @ R[1].T))))


def frames_of(motion: Motion, state: BodyState) -> NDArray:
    """(S, 12) frames of the segments."""
    return motion.body.tree.forward(state.T_world_root, state.angles)[0]
