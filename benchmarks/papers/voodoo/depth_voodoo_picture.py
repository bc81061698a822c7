"""The picture of `docs/papers/p2.md`: three movements by depth, by features, by both.

    python -m benchmarks.papers.voodoo.depth_voodoo_picture

Of each movement two frames: the depth image, the rendered colour picture with what was found by the colour of the skin,
the body as tracked with depth alone, with face and hands alone, with both, and the truth.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import ROOT
from benchmarks.scenes.regions_scene import face_normals
from kinefit.bodies import Body, BodyState
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera
from kinefit.simulation.evaluation.sequences import INPUTS, TruthSequence, sequence
from kinefit.simulation.evaluation.voodoo import voodoo_method
from kinefit.simulation.movements import people
from kinefit.simulation.rendering.scenes import ColourSensor, SimulatedScene, picture

PICTURE = ROOT / "docs" / "images" / "voodoo.jpg"
SHOWN = {"wave": (0.46, 0.5), "bow": (0.45, 0.6), "arms_at_sensor": (0.4, 0.5)}  # movement: shares of its time
TITLES = ("depth image", "colour, what was found", "3D alone", "2D alone", "fusion", "truth")
_NEAR, _FAR = 1.5, 5.0  # [m] of the grey levels
_BODY, _RIGHT, _LEFT = (125, 150, 90), (60, 110, 200), (170, 110, 50)  # BGR
_SIZE = 1.25  # of a cell, in pixels of the depth camera
_FOUND = (60, 220, 240)


def drawn(body: Body, state: BodyState, camera: Camera, back: NDArray) -> NDArray:
    """A picture (H, W, 3) with the body on it, its sides in two colours, lit from in front."""
    mesh = body_mesh(body)
    raster = render_body(body, state, camera, mesh=mesh)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    light = 0.45 + 0.55 * np.abs(face_normals(mesh.posed(frames), mesh.faces) @ camera.T_camera_world[2, :3])
    sides = {"r": _RIGHT, "l": _LEFT}
    colours = np.array([sides.get(name.rsplit("_", 1)[-1], _BODY) for name in body.tree.segments], float)
    painted = light[raster.face][..., None] * colours[raster.segment]
    return np.where(raster.seen[..., None], painted, back).astype(np.uint8)


def row(run: TruthSequence, share: float, fitted: list) -> NDArray:
    """One frame of a sequence, cell beside cell."""
    frame, camera = round(share * (len(run.truth) - 1)), run.rig["depth"]
    depth = np.asarray(run.depth[frame].depth)
    grey = np.clip(255.0 * (_FAR - depth) / (_FAR - _NEAR), 30, 255) * (depth > 0)
    back = np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
    colour = run.rig["colour"]
    sensor = ColourSensor("colour", colour.size, colour.matrix[0, 0])
    seen = picture(SimulatedScene.of(run.truth, camera), frame, colour, sensor)
    for uv in run.features[frame].uv[np.isfinite(run.features[frame].uv[:, 0])]:
        cv2.circle(seen, (round(uv[0]), round(uv[1])), 7, _FOUND, 2, cv2.LINE_AA)
    seen = cv2.resize(seen, camera.size, interpolation=cv2.INTER_AREA)
    cells = [back, seen] + [drawn(m.body, m.state(frame), camera, back) for m in (*fitted, run.truth)]
    cells = [cv2.resize(c, None, fx=_SIZE, fy=_SIZE, interpolation=cv2.INTER_CUBIC) for c in cells]
    return np.concatenate(cells, axis=1)


def main(path: Path = PICTURE) -> None:
    """Draw it."""
    crowd, rows = people(seed=1), []
    for name, shares in SHOWN.items():
        run = sequence(name, crowd[0], seed=1)
        start = run.truth.state(0)
        fitted = [voodoo_method(run, inputs, start) for inputs in INPUTS]
        rows += [row(run, share, fitted) for share in shares]
    width = rows[0].shape[1] // len(TITLES)
    head = np.full((24, rows[0].shape[1], 3), 255, np.uint8)
    for k, title in enumerate(TITLES):
        cv2.putText(head, title, (k * width + 6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
    cv2.imwrite(str(path), np.concatenate([head, *rows]), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
