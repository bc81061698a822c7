"""A pedal and a snowboarder by colours of rendered images: the paper's system of (6), (18) and (19) (P3 3.2).

Of the pedal of P3 3.1 thigh and shank are seen, the crank is not. Starts are closed poses 8.6 degrees of the crank
away. The factor of the closure's equations was chosen at cranks of 0.85 and 1 rad (10 of 1, 3, 10, 30, 100); the six
here are others. The snowboarder's left boot is tied to its binding by four pairs of points; knees and hips start 0.1
rad off.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.papers.closures.closures_planar import UNIT, explicit, pedal
from kinefit.bodies import Body, BodyState, TaperedCylinder, load_body
from kinefit.bodies.parts import known_gear
from kinefit.bodies.rendering import render_body
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.papers.regions import pose_from_regions
from kinefit.solving.closed import onto
from kinefit.solving.correspondences.closures import closure_values, hard_equations

AWAY = 0.15  # [rad] of the crank, from the start to the pose that is seen
CRANKS = (-2.6, -1.6, 0.6, 1.4, 2.0, 2.6)  # [rad], away from the stretched leg at 0
FACTORS = (1.0, 10.0, 100.0)


def run() -> None:
    """Print the figures."""
    boots()
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


def boots() -> None:
    """Boot and binding, four cameras around the snowboarder."""
    closed = known_gear(load_body("snowboarder"))
    equations = hard_equations(closed)
    assert equations is not None
    start, _ = onto(closed, closed.default_state(), equations)
    bent = np.array([0.1 if "knee" in name or "hip_flexion" in name else 0.0 for name in closed.tree.coordinates])
    truth, _ = onto(closed, start.retract(np.append(np.zeros(6), bent)), equations)
    cameras = Rig(tuple(_camera(f"{turn:.1f}", turn, 0.0, 4.0) for turn in 0.4 + np.pi / 2 * np.arange(4)))
    images = {camera.name: _image(closed, truth, camera) for camera in cameras}
    gap = {}
    for name, body in {"with": closed, "without": replace(closed, closures=())}.items():
        fit = pose_from_regions(body, start, cameras, images, cycles=amount(60, 10))
        off = closure_values(closed, fit.state)
        gap[name] = 1e3 * float(np.linalg.norm(off[:3]))
        places = [closed.positions(state, closed.landmarks) for state in (fit.state, truth, start)]
        far = [1e3 * float(np.linalg.norm(x - places[1], axis=1).mean()) for x in places]
        turn = float(np.degrees(np.linalg.norm(off[3:])))
        print(f"  {name}: boot {gap[name]:.2f} mm, {turn:.2f} deg; landmarks {far[0]:.1f} mm, start {far[2]:.1f}")
    figure("snowboarder by colours, equations (18) and (19): boot from binding", gap["with"], "mm", "<= 5")
    name = "snowboarder by colours: boot from binding without closures over that with (18) and (19)"
    figure(name, gap["without"] / gap["with"], "times", ">= 5")


def _with_surfaces(body: Body) -> Body:
    ends = {"thigh": (3 * UNIT, ((0.07, 0.07), (0.05, 0.05))), "shank": (2 * UNIT, ((0.05, 0.05), (0.035, 0.035)))}
    parts = [TaperedCylinder(body.tree.segment(s), (0.0, 0.0, 0.0), (0.0, y, 0.0), r) for s, (y, r) in ends.items()]
    return replace(body, surfaces=tuple(parts))


def _camera(name: str, turn: float, height: float = 2 * UNIT, distance: float = 2.5) -> Camera:
    """So far [m] from a point of the vertical y, turned about it."""
    z = -np.array([np.sin(turn), 0.0, np.cos(turn)])
    x = np.cross([0.0, 1.0, 0.0], z)
    R = np.stack([-x, [0.0, -1.0, 0.0], z])
    place = np.array([0.0, height, 0.0]) - distance * z
    matrix = [[250.0, 0.0, 99.5], [0.0, 250.0, 79.5], [0.0, 0.0, 1.0]]
    return Camera(name, (200, 160), matrix, T_camera_world=se3.transform(R, -R @ place))


def _image(body: Body, state: BodyState, camera: Camera) -> NDArray:
    image = np.full((*camera.size[::-1], 3), (30, 90, 40), np.uint8)
    image[render_body(body, state, camera).seen] = (200, 60, 50)
    return image
