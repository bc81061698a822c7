"""A face is unrecognisable where the head is fitted, and all of the picture where it is not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit.bodies import load_body
from kinefit.errors import ExportError
from kinefit.exporters.pictures.privacy import without_face

RNG = np.random.default_rng(0)


def scene():
    motion, camera = smooth_motion(3), a_camera("cam", 0.3)
    motion = replace(
        motion, quality=np.ones(3), segment_quality=np.ones_like(motion.segment_quality),
        joint_std=np.full_like(motion.joint_std, 0.005),
    )  # fmt: skip
    width, height = camera.size
    return motion, camera, RNG.integers(0, 255, (height, width, 3)).astype(np.uint8)


def test_the_head_is_blurred_and_the_feet_are_not():
    motion, camera, image = scene()
    out = without_face(image, motion, 1, camera)
    places = motion.body.positions(motion.state(1), motion.body.landmarks)
    uv = dict(zip(motion.body.landmarks.names, camera.project(places).round().astype(int)))
    u, v = uv["nose_tip"]
    assert out[v - 6 : v + 7, u - 6 : u + 7].std() < 0.25 * image[v - 6 : v + 7, u - 6 : u + 7].std()
    changed = np.argwhere((out != image).any(axis=2))
    assert len(changed) and not (out != image)[uv["l_heel"][1]].any()
    assert image is not out


@pytest.mark.parametrize("why", ["no frame", "nobody", "lost", "unknown"])
def test_where_the_head_is_not_known_nothing_is_sharp(why):
    motion, camera, image = scene()
    frame = None if why == "no frame" else 1
    if why == "nobody":
        motion = replace(motion, quality=np.zeros(3))
    if why == "lost":
        motion = replace(motion, segment_quality=np.zeros_like(motion.segment_quality))
    if why == "unknown":
        motion = replace(motion, joint_std=np.full_like(motion.joint_std, np.inf))
    out = without_face(image, motion, frame, camera)
    assert out.shape == image.shape and out.std() < 0.25 * image.std()


@pytest.mark.parametrize("away", [0.0, 3.0])
def test_a_head_about_the_camera_leaves_nothing_sharp_and_one_behind_it_all(away):
    motion, camera, image = scene()
    head = motion.body.positions(motion.state(1), motion.body.landmarks)[motion.body.landmarks.index("nose_tip")]
    T = np.array(camera.T_camera_world)
    T[:3, 3] = -T[:3, :3] @ head - np.array([0.0, 0.0, away])  # the nose at the camera, or so far behind it
    out = without_face(image, motion, 1, replace(camera, T_camera_world=T))
    assert (out == image).all() if away else out.std() < 0.25 * image.std()


def test_a_body_without_a_head_is_refused():
    motion, camera, image = scene()
    arm = replace(motion, body=load_body("arm"))
    with pytest.raises(ExportError, match="without a head"):
        without_face(image, arm, 1, camera)
