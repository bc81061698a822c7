"""An arm sequence with a shoulder that morphs, seen as outlines in three views: the morphed model beside the rigid one.

200 rendered frames, as in the paper's figures 4, 10 and 11: both arms are raised and brought forward, elbows bend. Free
are the root and three joints of each arm; what is fitted are outlines alone, frame after frame.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import ROOT, amount, figure
from benchmarks.scenes.curves import COLOURS, curves
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import JointMotion, LocalMorph
from kinefit.bodies.rendering import Canvas
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import geman_mcclure
from kinefit.images.silhouette import outline
from kinefit.solving.correspondences.contours.outlines import RimFinder, morphed_outline_rows, outline_pairs
from kinefit.solving.least_squares import gauss_newton

FRAMES, SIZE, FOCAL = 200, (640, 480), 560.0
JOINTS = tuple(f"{name}_{side}" for side in "rl" for name in ("arm_flex", "arm_add", "elbow_flex"))
BOUNDS = (12.0, 8.0, 5.0, 4.0, 3.0, 3.0)  # [px] within which outlines are paired, iteration by iteration
PICTURE = ROOT / "docs" / "images" / "morphing_arm.svg"
SEEN, DRAWN = amount(FRAMES, 5), amount(PICTURE, None)


def cameras() -> list[Camera]:
    """Three views, in front and to both sides, 3 m away."""
    out = []
    for k, azimuth in enumerate(np.radians([-55.0, 0.0, 60.0])):
        z = -np.array([np.cos(azimuth), 0.15, np.sin(azimuth)])  # the person looks along x
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        centre = np.array([0.0, 0.35, 0.0]) - 3.0 * z
        K = [[FOCAL, 0, SIZE[0] / 2 - 0.5], [0, FOCAL, SIZE[1] / 2 - 0.5], [0, 0, 1]]
        out.append(Camera(f"cam{k}", SIZE, K, (), "radtan", se3.transform(R, -R @ centre)))
    return out


def sequence(body: Body, frames: int = FRAMES) -> list[BodyState]:
    """Arms up and forward at changing pace, right and left apart; the trunk sways."""
    t, out = np.linspace(0.0, 2.0 * np.pi, frames), []
    q = {
        "arm_add_r": -40 - 28 * np.sin(t), "arm_flex_r": 55 - 50 * np.cos(2 * t),
        "elbow_flex_r": 45 - 30 * np.cos(3 * t), "arm_add_l": -40 + 28 * np.sin(1.5 * t),
        "arm_flex_l": 60 + 55 * np.sin(t), "elbow_flex_l": 50 + 35 * np.sin(2.5 * t),
    }  # fmt: skip
    for k in range(frames):
        angles = body.default_state().angles.copy()
        for name, values in q.items():
            angles[body.tree.coordinate(name)] = np.radians(values[k])
        sway = [0.03 * np.sin(t[k]), 0.0, 0.02 * np.sin(2 * t[k]), 0.0, 0.08 * np.sin(t[k]), 0.0]
        out.append(BodyState(se3.exp(sway), angles))
    return out


def outlines(model: Morphing, states: list[BodyState], views: list[Camera]) -> list[list[NDArray]]:
    """Outlines (4, N) in every view of every frame, drawn at twice the size."""
    large = [camera.scaled((2 * SIZE[0], 2 * SIZE[1])) for camera in views]
    canvas, out = Canvas(large[0].size), []
    for state in states:
        vertices, several = model.pose(state).vertices, []
        for camera in large:
            drawn = canvas.draw_for(camera, vertices, model.mesh.faces, cull=True).seen
            mask = cv2.resize(drawn.astype(np.uint8) * 255, SIZE, interpolation=cv2.INTER_AREA)
            several.append(np.ascontiguousarray(outline(mask)[:, ::2]))
        out.append(several)
    return out


def track(model: Morphing, seen: list[list[NDArray]], views: list[Camera], first: BodyState) -> NDArray:
    """(F, 6) [rad] angles found from outlines; each frame starts where the last one, and its change, led to."""
    tree, finder = model.body.tree, RimFinder(model.mesh)
    joints = [6 + tree.coordinate(name) for name in JOINTS]
    locked = np.ones(tree.n_dofs, bool)
    locked[[*range(6), *joints]] = False
    state, found, speed = first, [], np.zeros(tree.n_dofs)
    for several in seen:
        before, state = state, state.retract(speed)
        for bound in BOUNDS:
            pose, parts = model.pose(state), []
            for camera, image in zip(views, several):
                rim = finder.find(pose.vertices, camera)
                rim = rim.chosen(~rim.inner)
                i, k = outline_pairs(rim.outline, image, reach=bound)
                parts.append(morphed_outline_rows(pose, rim.chosen(i), camera, image[:, k], sigma=bound / 3.0))
            state = gauss_newton(model.body, state, parts, loss=geman_mcclure(2.0), locked=locked, damping=1e-3).state
        speed = before.difference(state) if found else speed
        found.append(state.angles[np.array(joints) - 6])
    return np.array(found)


def louder(body: Body, factor: float) -> Body:
    """The body with morphs that go further."""
    out = []
    for m in body.morphs:
        if isinstance(m, JointMotion):
            m = replace(m, twist=factor * np.asarray(m.twist))
        elif isinstance(m, LocalMorph):
            m = replace(m, shift=factor * np.asarray(m.shift))
        out.append(m)
    return replace(body, morphs=tuple(out))


def run(frames: int = SEEN, picture: Path | None = DRAWN) -> None:
    """Print every figure, and draw the curves."""
    body, views = load_body("humanoid_morphing"), cameras()
    model, rigid = Morphing(body), Morphing(replace(body, morphs=()))
    states = sequence(body, FRAMES)[:frames]
    truth = np.array([[s.angles[body.tree.coordinate(n)] for n in JOINTS] for s in states])
    seen = outlines(model, states, views)
    found, stiff = track(model, seen, views, states[0]), track(rigid, seen, views, states[0])
    error, plain = (float(np.degrees(np.abs(a - truth)).mean()) for a in (found, stiff))
    figure("morphing_arm_deg", error, "deg mean", "<= 2.5")
    figure("morphing_arm_to_rigid", error / plain, f"of the rigid model's {plain:.2f} deg", "<= 0.5")
    two = track(model, [s[1:] for s in seen], views[1:], states[0])
    figure("morphing_arm_two_views_deg", float(np.degrees(np.abs(two - truth)).mean()), "deg mean", "<= 2.5")
    person = outlines(Morphing(louder(body, 1.5)), states, views)  # whose shoulder moves further than the model's
    other, stiffer = track(model, person, views, states[0]), track(rigid, person, views, states[0])
    error, worse = (float(np.degrees(np.abs(a - truth)).mean()) for a in (other, stiffer))
    figure("morphing_arm_other_person_deg", error, "deg mean, the shoulder moves half as far again", "<= 2.5")
    figure("morphing_arm_other_person_to_rigid", error / worse, f"of the rigid model's {worse:.2f} deg", "<= 0.5")
    if picture:
        draw(picture, truth, found, stiff)


def draw(picture: Path, truth: NDArray, found: NDArray, stiff: NDArray) -> None:
    """Curves as in the paper's figure 4: one panel an arm."""
    frame, panels = np.arange(len(truth)), []
    for title, own in (("right arm", (0, 1, 2)), ("left arm", (3, 4, 5))):
        lines = []
        for joint, colour in zip(own, COLOURS):
            for values, dashes in ((truth, ""), (found, "5 3"), (stiff, "1.5 3")):
                lines.append((frame, np.degrees(values[:, joint]), colour, dashes))
        panels.append((title, lines))
    names = ("arm_flex", "arm_add", "elbow_flex")
    legend = dict(zip(names, COLOURS)) | {"truth": "#444 ", "morphed": "#444 5 3", "rigid": "#444 1.5 3"}
    curves(picture, panels, x="frame", y="angle [deg]", legend=legend)
