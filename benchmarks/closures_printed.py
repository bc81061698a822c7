"""The pedal of P3 3.1 by the colours of two rendered images: the paper's system of (6), (18) and (19), and without.

Thigh and shank are seen, the crank is not. Starts are closed poses 8.6 degrees of the crank away. The factor of the
closure's equations was chosen at cranks of 0.85 and 1 rad (10 of 1, 3, 10, 30, 100); the six here are others.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.closures_planar import UNIT, explicit, pedal
from benchmarks.figures import amount, figure
from kinefit.bodies import Body, BodyState, TaperedCylinder
from kinefit.correspondences.closures import closure_values
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.recipes.regions import pose_from_regions
from kinefit.rendering import render_body

AWAY = 0.15  # [rad] of the crank, from the start to the pose that is seen
CRANKS = (-2.6, -1.6, 0.6, 1.4, 2.0, 2.6)  # [rad], away from the stretched leg at 0
FACTORS = (1.0, 10.0, 100.0)


def run() -> None:
    """Print the figures."""
    closed = _with_surfaces(pedal('mode = "hard"'))
    cameras = Rig(tuple(_camera(name, turn) for name, turn in (("front", 0.0), ("beside", 0.7))))
    cases = [(closed, {"closure_factor": f}, f"factor {f:g}") for f in FACTORS]
    found = {}
    for body, setting, name in [*cases, (replace(closed, closures=()), {}, "without closures")]:
        off = []
        for crank in amount(CRANKS, CRANKS[2:3]):
            truth, start = (BodyState(np.eye(4), explicit(c)[1]) for c in (crank, crank - AWAY))
            images = {camera.name: _image(closed, truth, camera) for camera in cameras}
            fit = pose_from_regions(body, start, cameras, images, **setting)
            gap = 1e3 * float(np.linalg.norm(closure_values(closed, fit.state)))
            off.append((gap, float(np.degrees(np.abs(fit.state.angles - truth.angles)[2])), fit.cycles))
        found[name] = worst = np.max(off, axis=0)
        print(f"  {name}: worst gap {worst[0]:.2f} mm, crank {worst[1]:.2f} deg, {worst[2]:.0f} cycles at most")
    figure("pedal by colours, equations (18) and (19): foot from pedal, worst", found["factor 10"][0], "mm", "<= 5")
    figure("pedal by colours, equations (18) and (19): crank, worst", found["factor 10"][1], "deg", "<= 2")
    name = "pedal by colours: foot from pedal without closures over that with (18) and (19)"
    figure(name, found["without closures"][0] / found["factor 10"][0], "times", ">= 5")


def _with_surfaces(body: Body) -> Body:
    ends = {"thigh": (3 * UNIT, ((0.07, 0.07), (0.05, 0.05))), "shank": (2 * UNIT, ((0.05, 0.05), (0.035, 0.035)))}
    parts = [TaperedCylinder(body.tree.segment(s), (0.0, 0.0, 0.0), (0.0, y, 0.0), r) for s, (y, r) in ends.items()]
    return replace(body, surfaces=tuple(parts))


def _camera(name: str, turn: float) -> Camera:
    """2.5 m away, turned about the vertical y."""
    z = -np.array([np.sin(turn), 0.0, np.cos(turn)])
    x = np.cross([0.0, 1.0, 0.0], z)
    R = np.stack([-x, [0.0, -1.0, 0.0], z])
    place = np.array([0.0, 2 * UNIT, 0.0]) - 2.5 * z
    matrix = [[250.0, 0.0, 99.5], [0.0, 250.0, 79.5], [0.0, 0.0, 1.0]]
    return Camera(name, (200, 160), matrix, T_camera_world=se3.transform(R, -R @ place))


def _image(body: Body, state: BodyState, camera: Camera) -> NDArray:
    image = np.full((*camera.size[::-1], 3), (30, 90, 40), np.uint8)
    image[render_body(body, state, camera).seen] = (200, 60, 50)
    return image
