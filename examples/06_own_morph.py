"""A body whose surface and joints change with its angles, written as TOML, and a fit that knows of it.

    python examples/06_own_morph.py [picture.png]
"""

import sys
from dataclasses import replace

import cv2
import numpy as np

import kinefit
from kinefit.bodies import rendering
from kinefit.solving import correspondences

ARM = """
[body]
name = "strong arm"
base = "arm"                                   # all of the catalogue's arm, and:

[[morph]]                                      # the biceps thickens as the elbow bends
kind = "local"
segment = "upperarm_r"
centre = [0.045, -0.15, 0.0]                   # metres, in the segment's frame
radii = [0.06, 0.09, 0.05]
shift = [0.025, 0.0, 0.0]
on = ["upperarm_r"]
angle = "elbow_flex_r"
start = 20                                     # degrees: nothing of it here,
end = 120                                      # all of it there
weight = "sqrt"                                # fast at first

[[morph]]                                      # and the joint of the elbow slides forward
kind = "joint"
segment = "forearm_r"
shift = [0.015, 0.0, 0.0]
angle = "elbow_flex_r"
start = 20
end = 120"""


def main(picture=None, seed=0):
    arm = kinefit.parse_body(ARM, "the arm of this example")
    model, rigid = kinefit.bodies.Morphing(arm), kinefit.bodies.Morphing(replace(arm, morphs=()))
    angles = dict.fromkeys(arm.tree.coordinates, 0.0) | {"arm_flex_r": 30.0, "elbow_flex_r": 100.0, "pro_sup_r": 80.0}
    truth = kinefit.BodyState(np.eye(4), np.radians(list(angles.values())))

    random = np.random.default_rng(seed)
    nodes, axes = np.repeat(random.choice(len(model.mesh.vertices), 150), 3), np.tile(np.eye(3), (150, 1))
    seen = model.pose(truth).vertices[nodes] + random.normal(scale=0.002, size=(450, 3))

    errors = {}
    for name, body in (("morphing", model), ("rigid", rigid)):
        state = arm.default_state()
        for _ in range(20):
            pose = body.pose(state)
            gap = np.sum(axes * (seen - pose.vertices[nodes]), axis=1)
            rows = correspondences.morphed_rows(pose, nodes, axes, gap, sigma=0.002)
            state = kinefit.solving.gauss_newton(arm, state, [rows, correspondences.prior_rows(arm, state)]).state
        errors[name] = np.degrees(np.abs(state.angles - truth.angles).max())
        print(f"{name:>9} model: angles off by at most {errors[name]:.2f} deg")
    if picture:
        cv2.imwrite(str(picture), np.hstack([drawn(m, truth) for m in (rigid, model)]))
    return errors


def drawn(model, state):
    """An image (H, W, 3) of a body from its right side, darker where it is further away."""
    T = np.array([[1.0, 0, 0, -0.15], [0, -1, 0, -0.2], [0, 0, -1, 1.2], [0, 0, 0, 1]])
    camera = kinefit.Camera("side", (480, 480), [[700, 0, 240], [0, 700, 240], [0, 0, 1]], (), "radtan", T)
    canvas = rendering.Canvas(camera.size)
    depth = canvas.draw_for(camera, model.pose(state).vertices, model.mesh.faces).depth
    grey = np.where(np.isfinite(depth), 220 - 1500 * (np.minimum(depth, 9) - 1.12), 255).clip(0, 255)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


if __name__ == "__main__":
    main(*sys.argv[1:2])
