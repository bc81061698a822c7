"""The paper's own method, on rendered pictures."""

from dataclasses import replace

import numpy as np
import pytest
from tests.sensors.scenes import ring

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas, render_body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.papers.silhouettes import contour_points, pose_from_contours, track_contours

COLOUR = (200, 60, 50)


def rig():
    cameras = []
    for name, x, z in (("front", (1.0, 0, 0), (0, 0, 1.0)), ("side", (0, 0, -1.0), (1.0, 0, 0))):
        R = np.stack([x, (0.0, -1.0, 0.0), -np.asarray(z)])
        R[0] = np.cross(R[1], R[2])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ (2.0 * np.asarray(z))
        cameras.append(Camera(name, (200, 160), [[200.0, 0, 99.5], [0, 200.0, 79.5], [0, 0, 1]], T_camera_world=T))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def body():
    return load_body("arm")


def state(body, i):
    angles = np.array(body.tree.usual)
    angles += np.radians(3.0) * i * np.linspace(1.0, 0.3, len(angles))
    return BodyState(np.eye(4), np.clip(angles, body.tree.lower, body.tree.upper))


def pictures(body, s, cameras):
    """What cameras see of a red body in a green room."""
    out = {}
    for camera in cameras:
        picture = np.full((*camera.size[::-1], 3), (30, 90, 40), np.uint8)
        picture[render_body(body, s, camera).seen] = COLOUR
        out[camera.name] = picture
    return out


def test_a_contour_is_where_the_colour_ends(body):
    s, camera = state(body, 0), rig()["front"]
    seen = render_body(body, s, camera).seen
    points = contour_points(pictures(body, s, [camera])["front"], (150, 20, 20), (255, 100, 100))
    u, v = points[:2].astype(int)
    assert len(u) > 50 and seen[v, u].mean() > 0.98
    rim = seen & ~(np.roll(seen, 1, 0) & np.roll(seen, -1, 0) & np.roll(seen, 1, 1) & np.roll(seen, -1, 1))
    assert rim[v, u].mean() > 0.6


def test_an_arm_is_followed_by_its_colour(body):
    cameras = rig()
    images = [pictures(body, state(body, i), cameras) for i in range(5)]
    colours = dict.fromkeys(cameras.names, ((150, 20, 20), (255, 100, 100)))
    fits = list(track_contours(body, state(body, 0), cameras, images, colours))
    far = np.linalg.norm(
        body.positions(fits[-1].state, body.landmarks) - body.positions(state(body, 4), body.landmarks), axis=1
    )
    start = np.linalg.norm(
        body.positions(state(body, 0), body.landmarks) - body.positions(state(body, 4), body.landmarks), axis=1
    )
    assert far.mean() < 0.3 * start.mean() and far.mean() < 0.02
    assert fits[-1].error < 0.02


def test_nothing_near_is_told(body):
    cameras = rig()
    away = {name: np.array([[190.0], [155.0], [0.0], [0.0]]) for name in cameras.names}
    with pytest.raises(ObservationError, match="no contour"):
        pose_from_contours(body, state(body, 0), cameras, away, reach=5.0)


def contours_of(model, s, cameras):
    """The contours of a skin or of a body that morphs, as cameras see them."""
    out = {}
    for camera in cameras:
        seen = Canvas(camera.size).draw_for(camera, model.pose(s).vertices, model.mesh.faces, cull=True).seen
        picture = np.where(seen[..., None], np.uint8(COLOUR), np.uint8((30, 90, 40))).astype(np.uint8)
        out[camera.name] = contour_points(picture, (150, 20, 20), (255, 100, 100))
    return out


def test_a_body_that_morphs_is_fitted_as_such_from_low_frequencies_to_high():
    body = load_body("humanoid_morphing")
    cameras = ring(3)
    arms = [body.tree.coordinate(name) for name in ("arm_add_r", "arm_flex_l")]

    def posed(degrees):
        angles = body.default_state().angles.copy()
        angles[arms] = np.radians([-50.0 - degrees, 60.0 + degrees])
        return BodyState(np.eye(4), angles)

    model = Morphing(body)
    seen = contours_of(model, posed(12.0), cameras)
    fits = {name: pose_from_contours(own, posed(0.0), cameras, seen, levels=2, cycles=12)
            for name, own in (("morphing", body), ("stiff", replace(body, morphs=())))}  # fmt: skip
    off = {name: np.degrees(np.abs(fit.state.angles - posed(12.0).angles))[arms].mean() for name, fit in fits.items()}
    assert off["morphing"] < 4.0 and off["morphing"] < off["stiff"]
    assert fits["morphing"].error < fits["stiff"].error
