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
from benchmarks.papers.silhouettes.silhouettes_morphing import FRAMES, JOINTS, cameras, sequence
from benchmarks.papers.silhouettes.silhouettes_shoulders import stiff
from benchmarks.scenes.takes import start_text
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.takes.track import track_take

SEEN = amount(FRAMES, 4)


def take_of_masks(folder: Path, drawn: Body, views: list[Camera], states: list[BodyState], head: str) -> Path:
    """A take of masks of all views, drawn at twice the size; `head` stands in [take], the first pose in [start]."""
    write_calibration(Rig(tuple(views)), folder / "rig.toml")
    model, start = Morphing(drawn), states[0]
    degrees = dict(zip(drawn.tree.coordinates, np.degrees(start.angles)))
    text = f'[take]\nrate = 30.0\nup = "y"\n{head}\n{start_text(start.T_world_root, degrees)}'
    text += '[calibration]\nfile = "rig.toml"\nunit = "m"\n'
    for camera in views:
        (folder / camera.name).mkdir(exist_ok=True)
        width, height = camera.size
        large = camera.scaled((2 * width, 2 * height))
        for i, state in enumerate(states):
            seen = Canvas(large.size).draw_for(large, model.pose(state).vertices, model.mesh.faces, cull=True).seen
            mask = cv2.resize(255 * seen.astype(np.uint8), camera.size, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / camera.name / f"{i:04d}.png"), mask)
        text += f'[[camera]]\nname = "{camera.name}"\nsize = [{width}, {height}]\n[[silhouette]]\n'
        text += f'camera = "{camera.name}"\nfile = "{camera.name}"\nrate = 30.0\nsigma = 1.0\n'
    (folder / "take.toml").write_text(text)
    return folder / "take.toml"


def angles(path: Path) -> NDArray:
    """(F, 6) [rad] angles of the arms that a take gives."""
    motion = track_take(path)[0]
    return motion.angles[:, [motion.body.tree.coordinate(name) for name in JOINTS]]


def run() -> None:
    """Print the mean errors."""
    body = load_body("humanoid_morphing")
    states = sequence(body)[:SEEN]
    truth = np.array([[s.angles[body.tree.coordinate(name)] for name in JOINTS] for s in states])
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        (folder / "stiff.toml").write_text(stiff())
        heads = [f'body = "{name}"\nsize = false' for name in (body.name, "stiff.toml")]
        takes = (take_of_masks(folder, body, cameras(), states, head) for head in heads)
        found = [np.degrees(np.abs(angles(path) - truth)) for path in takes]
    print("#   angle by angle, morphing {}, stiff {}".format(*(np.round(error.mean(axis=0), 2) for error in found)))
    morphing, rigid = (float(error.mean()) for error in found)
    figure("morphing_arm_take_deg", morphing, "deg mean, by a take, every joint free", "<= 0.5")
    figure("morphing_arm_take_to_rigid", morphing / rigid, f"of the stiff body's {rigid:.2f} deg", "<= 0.5")
