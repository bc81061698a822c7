"""The arm sequence of `silhouettes_morphing` by `kinefit track`: masks of three views, `[start]`, every joint free.

`humanoid_morphing` and the same body held stiff, 200 frames; the errors are those of the six angles of the arms.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.silhouettes_morphing import FRAMES, JOINTS, SIZE, cameras, sequence
from benchmarks.silhouettes_shoulders import stiff
from kinefit.bodies import BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.rendering import Canvas
from kinefit.takes.track import track_take

SEEN = amount(FRAMES, 4)


def write_masks(folder: Path, states: list[BodyState]) -> None:
    """Calibration and masks of all views, drawn at twice the size."""
    model, views = Morphing(load_body("humanoid_morphing")), cameras()
    write_calibration(Rig(tuple(views)), folder / "rig.toml")
    large = [camera.scaled((2 * SIZE[0], 2 * SIZE[1])) for camera in views]
    canvas = Canvas(large[0].size)
    for camera in views:
        (folder / camera.name).mkdir()
    for i, state in enumerate(states):
        vertices = model.pose(state).vertices
        for camera in large:
            drawn = canvas.draw_for(camera, vertices, model.mesh.faces, cull=True).seen
            mask = cv2.resize(255 * drawn.astype(np.uint8), SIZE, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / camera.name / f"{i:04d}.png"), mask)


def angles(folder: Path, body: str, start: BodyState) -> NDArray:
    """(F, 6) [rad] angles of the arms that the take of a body's name or file gives."""
    tree, T = load_body("humanoid_morphing").tree, start.T_world_root
    listed = ", ".join(f"{name} = {np.degrees(q):.4f}" for name, q in zip(tree.coordinates, start.angles))
    text = f'[take]\nrate = 30.0\nup = "y"\nbody = "{body}"\nsize = false\n[start]\nat = {T[:3, 3].tolist()}\n'
    text += f"forward = {T[:3, 0].tolist()}\nupward = {T[:3, 1].tolist()}\nangles = {{ {listed} }}\n"
    text += '[calibration]\nfile = "rig.toml"\nunit = "m"\n'
    for camera in cameras():
        text += f'[[camera]]\nname = "{camera.name}"\nsize = {list(SIZE)}\n[[silhouette]]\ncamera = "{camera.name}"\n'
        text += f'file = "{camera.name}"\nrate = 30.0\nsigma = 1.0\n'
    (folder / "take.toml").write_text(text)
    motion = track_take(folder / "take.toml")[0]
    return motion.angles[:, [motion.body.tree.coordinate(name) for name in JOINTS]]


def run() -> None:
    """Print the mean errors."""
    body = load_body("humanoid_morphing")
    states = sequence(body)[:SEEN]
    truth = np.array([[s.angles[body.tree.coordinate(name)] for name in JOINTS] for s in states])
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        write_masks(folder, states)
        (folder / "stiff.toml").write_text(stiff())
        found = [np.degrees(np.abs(angles(folder, name, states[0]) - truth)) for name in (body.name, "stiff.toml")]
    print("#   angle by angle, morphing {}, stiff {}".format(*(np.round(error.mean(axis=0), 2) for error in found)))
    morphing, rigid = (float(error.mean()) for error in found)
    figure("morphing_arm_take_deg", morphing, "deg mean, by a take, every joint free", "<= 0.5")
    figure("morphing_arm_take_to_rigid", morphing / rigid, f"of the stiff body's {rigid:.2f} deg", "<= 0.5")


if __name__ == "__main__":
    run()
