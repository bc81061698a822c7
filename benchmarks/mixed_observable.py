"""What a mix of sensors can observe of a known motion, apart from any tracker (for `benchmarks.mixed`).

At every tenth frame the true body's measurements are linearised about the truth: keypoints (8 px), markers (10 mm),
nodes of the true skin that the depth camera sees (3 cm along their normals, as neighbours err alike) and those on the
occluding contour in a camera with a mask (3 cm). With the catalogue's spread of the angles as prior, a joint centre's
coordinate is observable where its standard deviation is below 5 cm, an angle where its variance is below half of the
prior's. The lengths of the body count as known.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.mixed_takes import CAMERAS, DETECTOR, MARKER_SET, MASK_SCALE, SENSOR, TWENTY, WRISTS_ANKLES
from kinefit import Motion
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.rendering import scaled
from kinefit.geometry.camera import Camera, Rig
from kinefit.simulation import SimulatedScene

EVERY, STEP = 10, 1e-4  # frames; [m], [rad]
PIXELS, MARKER, SURFACE = 8.0, 0.01, 0.03  # [px], [m], [m]
SURE, EXPLAINED = 0.05, 0.5  # [m], share of the prior's variance
_ROOT = 10.0  # [m], [rad] prior of the root: none to speak of


def observable(truth: Motion, rig: Rig, parts: Sequence[str]) -> tuple[NDArray, NDArray]:
    """Shares (S, 3) and (D,) of the frames in which joint centres and angles are observable; `parts` as of takes."""
    body = truth.body
    assert body.skin is not None
    scene = SimulatedScene(truth, body.skin)  # type: ignore[arg-type]
    prior = 1.0 / np.square(np.concatenate([np.full(6, _ROOT), body.tree.spread]))
    joints, angles = [], []
    for i in range(0, len(truth), EVERY):
        state = truth.state(i)
        rows = [np.zeros((0, len(prior)))]
        for cameras, part in ((CAMERAS[:2], "keypoints"), (CAMERAS[:1] * (i == 0), "first keypoints")):
            if part in parts:
                rows += [_pixels(body, state, rig[name]) for name in cameras]
        names = {"markers 4": WRISTS_ANKLES, "markers 20": TWENTY, "markers 45": body.markers(MARKER_SET).names}
        for part in names.keys() & set(parts):
            J = _change(body, state, body.markers(MARKER_SET).select(names[part]))
            rows.append(J.reshape(-1, J.shape[-1]) / MARKER)
        if "depth" in parts:
            rows.append(_surface(scene, i, rig[SENSOR.name], outline=False))
        for name in CAMERAS if "all masks" in parts else CAMERAS[:2] if "masks" in parts else ():
            rows.append(_surface(scene, i, scaled(rig[name], MASK_SCALE), outline=True))
        A = np.concatenate(rows)
        covariance = np.linalg.inv(A.T @ A + np.diag(prior))
        centres = _change(body, state, PointSet(body.tree.segments, np.arange(len(body.joints)), np.zeros((20, 3))))
        variance = np.einsum("sij,jk,sik->si", centres, covariance, centres)
        joints.append(variance < SURE**2)
        angles.append(np.diag(covariance)[6:] < EXPLAINED / prior[6:])
    return np.mean(joints, axis=0), np.mean(angles, axis=0)


def _change(body: Body, state: BodyState, points: PointSet) -> NDArray:
    """(K, 3, 6 + D) change of points in the world by every degree of freedom."""
    count = 6 + len(state.angles)
    moved = [state.retract(step) for step in STEP * np.concatenate([np.eye(count), -np.eye(count)])]
    x = body.trajectories(np.array([s.T_world_root for s in moved]), np.array([s.angles for s in moved]), points)
    return np.moveaxis(x[:count] - x[count:], 0, -1) / (2 * STEP)


def _pixels(body: Body, state: BodyState, camera: Camera) -> NDArray:
    """(2 K, 6 + D) rows of a detector's points in a camera."""
    points = body.keypoints(DETECTOR)
    x, J = body.positions(state, points), _change(body, state, points)
    by_place = [(camera.project(x + d) - camera.project(x - d)) / (2 * STEP) for d in STEP * np.eye(3)]
    rows = np.einsum("ukc,kcd->kud", np.array(by_place).transpose(2, 1, 0), J).reshape(-1, J.shape[-1]) / PIXELS
    return rows[np.isfinite(rows).all(axis=1)]


def _surface(scene: SimulatedScene, frame: int, camera: Camera, *, outline: bool) -> NDArray:
    """Rows (N, 6 + D) of the skin's nodes that a depth camera sees, or of those on the outline."""
    body, state = scene.motion.body, scene.motion.state(frame)
    skin = scene.mesh
    view = scene.view(frame, camera)
    normals = np.zeros_like(view.vertices)
    np.add.at(normals, view.faces.ravel(), np.repeat(view.normals[:-1], 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    z = (view.vertices @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3])[:, 2]
    width, height = camera.size
    uv = np.round(np.nan_to_num(camera.project(view.vertices), nan=-1.0)).astype(int)
    inside = np.all((uv >= 0) & (uv < (width, height)), axis=1)
    u, v = np.clip(uv, 0, (width - 1, height - 1)).T
    if outline:
        shown = view.raster.seen.astype(np.uint8)
        edge = cv2.morphologyEx(shown, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
        ray = view.vertices - camera.centre_world
        across = np.abs(np.sum(normals * ray, axis=1)) < 0.3 * np.linalg.norm(ray, axis=1)
        chosen = inside & across & edge[v, u]
    else:
        chosen = inside & (z < view.raster.depth[v, u] + 0.03)
    names = tuple(map(str, np.flatnonzero(chosen)))
    segments = np.asarray(skin.segment)[chosen]
    frames = scene.motion.segment_poses()[frame][segments]
    local = np.einsum("nji,nj->ni", frames[:, :3, :3], view.vertices[chosen] - frames[:, :3, 3])
    J = _change(body, state, PointSet(names, segments, local))
    return np.einsum("nc,ncd->nd", normals[chosen], J) / SURFACE
