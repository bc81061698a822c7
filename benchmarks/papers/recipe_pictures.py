"""The pictures of `docs/papers/p3.md` and `docs/papers/p4.md`.

    python -m benchmarks.papers.recipe_pictures
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import ROOT
from kinefit.bodies import Body, BodyState, PointSet, load_body
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces import MeshSurface, Metaballs
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh, sample
from kinefit.bodies.tree import KinematicTree
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.papers._colour_densities import COLOURS, DENSITIES, colour_cells
from kinefit.papers.metaball_bodies import metaball_bodies
from kinefit.papers.regions import pose_from_regions
from kinefit.solving.correspondences.contours.outlines import RimFinder

IMAGES = ROOT / "docs" / "images"
_SCALE = 3  # of the small image of regions
_OUT, _IN, _FIT = (80, 255, 80), (0, 0, 0), (255, 255, 255)  # BGR


def thing() -> Body:
    """A rigid body of two blocks."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
                      (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip
    x = np.concatenate([corners * (0.08, 0.02, 0.03), corners * (0.02, 0.04, 0.02) + (0.05, 0.05, 0.01)])
    none = np.zeros(0)
    tree = KinematicTree(
        ("thing",), np.array([-1]), np.zeros((1, 3)), (), none, np.zeros((0, 3)), none, none, none, none, none
    )
    surface = MeshSurface(0, x, np.concatenate([faces, faces + 8]))
    return Body("thing", tree, ("free",), ("whole",), np.zeros(1, int), PointSet(("middle",), np.zeros(1, int),
                np.zeros((1, 3))), surfaces=(surface,))  # fmt: skip


def regions() -> NDArray:
    """(H, W, 3) BGR: the start with its shifts, and the fit."""
    camera = Camera("cam", (240, 180), [[300.0, 0, 119.5], [0, 300.0, 89.5], [0, 0, 1]])
    body, random = thing(), np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3], T[2, 3] = se3.exp_so3(np.array([0.3, -0.4, 0.2])), 0.5
    true = BodyState(T, np.zeros(0))
    start = BodyState(se3.transform(se3.exp_so3(np.array([0.0, 0.0, 0.14])) @ T[:3, :3], T[:3, 3] + (0.01, 0.0, 0.0)),
                      np.zeros(0))  # fmt: skip
    squares = (np.add.outer(np.arange(180) // 17, np.arange(240) // 23) % 2)[..., None]
    image = np.where(squares == 0, (90, 120, 90), (120, 110, 150)).astype(float)
    image[render_body(body, true, camera).seen] = (190, 60, 50)
    image = np.clip(image + random.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    fit = pose_from_regions(body, start, Rig((camera,)), {"cam": image})
    mesh, pictures = body_mesh(body), []
    for state, shifts in ((start, True), (fit.state, False)):
        shown = cv2.resize(image[..., ::-1], None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
        pictures.append(_contour(shown, image, body, mesh, state, camera, shifts))
    return np.concatenate(pictures, axis=1)


def _contour(shown: NDArray, image: NDArray, body: Body, mesh: BodyMesh, state: BodyState, camera: Camera,
             shifts: bool) -> NDArray:  # fmt: skip
    """A picture with the contour, and to which side each of its points is shifted."""
    finder = RimFinder(mesh)
    rim = finder.find(mesh.posed(body.tree.forward(state.T_world_root, state.angles)[0]), camera, inner=False)
    inside, cell = (finder.drawn(camera) >= 0).ravel(), colour_cells(image, camera)
    counts = (np.bincount(cell[of], minlength=COLOURS).astype(float) for of in (inside, ~inside))
    p1, p2 = map(DENSITIES["parzen"], counts)
    u, v = np.rint(rim.outline[:2]).astype(int)
    here = cell[v * camera.size[0] + u]
    out = np.ascontiguousarray(shown)
    for place, normal, sign in zip(rim.outline[:2].T, rim.outline[2:].T, np.sign(p1[here] - p2[here])):
        at = tuple(int(x) for x in np.rint(_SCALE * (place + 0.5)))
        if shifts:
            to = tuple(int(x) for x in np.rint(_SCALE * (place + 0.5 + 4 * sign * normal)))
            cv2.line(out, at, to, _OUT if sign > 0 else _IN, 1, cv2.LINE_AA)
        cv2.circle(out, at, 1, _FIT, -1, cv2.LINE_AA)
    return out


def metaballs() -> NDArray:
    """(H, W, 3) BGR: points of an arm over the catalogue's arm, and over the fitted one."""
    generic, random = load_body("arm_metaballs"), np.random.default_rng(24)
    grown = tuple(
        s.changed(np.array(s.radii) * random.uniform(0.85, 1.15, s.radii.shape)) if isinstance(s, Metaballs)
        else s for s in generic.surfaces
    )  # fmt: skip
    true, points, starts = replace(generic, surfaces=grown), [], []
    low, high = np.maximum(true.tree.lower, -1.0), np.minimum(true.tree.upper, 1.0)
    for k in range(6):
        state = BodyState(np.eye(4), random.uniform(low, high))
        rest, _, segment = sample(true, 1000, seed=k)
        f = true.tree.forward(state.T_world_root, state.angles)[0][segment]
        points.append((f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:])
        off = random.normal(scale=0.07, size=len(state.angles))
        starts.append(BodyState(np.eye(4), np.clip(state.angles + off, true.tree.lower, true.tree.upper)))
    found = metaball_bodies(generic, points, starts)
    x = points[0]
    z, middle = np.array([0.0, 0.0, -1.0]), 0.5 * (x.min(axis=0) + x.max(axis=0))
    R = np.array([[1.0, 0, 0], [0, -1.0, 0], z])
    camera = Camera("cam", (420, 420), [[900.0, 0, 209.5], [0, 900.0, 209.5], [0, 0, 1]],
                    T_camera_world=se3.transform(R, -R @ (middle - 1.6 * z)))  # fmt: skip
    pictures = []
    for body, state in ((generic, starts[0]), (found.body, found.states[0])):
        raster = render_body(body, state, camera)
        depth = np.where(raster.seen, raster.depth, np.nan)
        light = np.clip(1.0 - 2.0 * np.abs(np.gradient(np.nan_to_num(depth, nan=1.6))[1]) * 60, 0.35, 1.0)
        out = np.where(raster.seen[..., None], light[..., None] * (190, 165, 120), 255.0).astype(np.uint8)
        uv = camera.project(x)
        for u, v in np.rint(uv[np.isfinite(uv).all(axis=1)]).astype(int):
            cv2.circle(out, (int(u), int(v)), 1, (40, 40, 200), -1, cv2.LINE_AA)
        pictures.append(out)
    return np.concatenate(pictures, axis=1)


if __name__ == "__main__":
    cv2.imwrite(str(IMAGES / "recipe_regions.png"), regions())
    cv2.imwrite(str(IMAGES / "recipe_metaballs.png"), metaballs())
    print(f"written: {IMAGES / 'recipe_regions.png'}, recipe_metaballs.png")
