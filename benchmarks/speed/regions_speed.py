"""Time of a frame of a whole person by colours: 640 x 480, from the colour images to a judged pose.

A rendered person (the catalogue's humanoid, painted in parts) sways before a wall of many colours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.scenes.silhouettes_scene import ring, swaying
from benchmarks.speed.rounds import tracked_rounds
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Rig
from kinefit.observations import ColourFrame

FRAMES, WARM, ROUNDS, RATE = amount(30, 10), 5, amount(5, 1), 30.0
PAINT = {"head": (200, 150, 130), "hand": (200, 150, 130), "forearm": (205, 155, 130), "upperarm": (40, 80, 160),
         "clavicle": (40, 80, 160), "thorax": (40, 80, 160), "abdomen": (45, 85, 165), "pelvis": (50, 45, 40),
         "thigh": (50, 45, 40), "shank": (55, 50, 45), "foot": (220, 220, 215), "toes": (220, 220, 215)}  # fmt: skip


def pictures(body: Body, rig: Rig, states: Sequence[BodyState], seed: int = 0) -> list[dict[str, NDArray]]:
    """(480, 640, 3) uint8 of every camera at every state."""
    random, mesh, out = np.random.default_rng(seed), body_mesh(body), []
    colour = np.array([PAINT[name.removesuffix("_r").removesuffix("_l")] for name in body.tree.segments], float)
    walls = {c.name: random.uniform(60, 200, (24, 32, 3)).repeat(20, axis=0).repeat(20, axis=1) for c in rig}
    for state in states:
        one = {}
        for camera in rig:
            drawn = render_body(body, state, camera, mesh=mesh)
            image = np.where(drawn.seen[..., None], colour[drawn.segment], walls[camera.name])
            one[camera.name] = np.clip(image + random.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
        out.append(one)
    return out


def run() -> None:
    """Print the processor time of a frame with one camera and with seven."""
    body = load_body("humanoid")
    rig, truth = ring(7), swaying(body, FRAMES)
    seen = pictures(body, rig, truth)
    print(f"# {len(body_mesh(body).faces)} triangles, 640 x 480, image processing included; processor time")
    for count, goal in ((1, "<= 10"), (7, "<= 70")):
        frames = [[ColourFrame(n, i / RATE, one[n]) for n in rig.names[:count]] for i, one in enumerate(seen)]
        told = tracked_rounds(body, rig, truth, frames, rate=RATE, rounds=ROUNDS, warm=WARM)
        cameras = "1 camera" if count == 1 else f"{count} cameras"
        unit = f"ms, median of each frame's best of {ROUNDS}"
        figure(f"whole person, {cameras}: CPU time a frame", told.ms, unit, goal)
        print(f"  {told.degrees:.1f} degrees off a joint, on average; lowest quality at the end {told.quality:.2f}")
