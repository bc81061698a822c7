"""Images of two people are parted by where their bodies are expected."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.depth_oracle import BODY, camera, facing

from kinefit.bodies.rendering import render_body
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_image import DepthImageSensor
from kinefit.sensors.visibility.occlusion import without_others

SETTINGS = TrackSettings()


def beside(state, x=0.0, z=0.0):
    T = np.array(state.T_world_root)
    T[:3, 3] += x, 0.0, z
    return replace(state, T_world_root=T)


@pytest.fixture(scope="module")
def pair():
    """Two who touch in the image, one half a metre before the other; each is expected 5 cm from where it is."""
    cam, one = camera(), facing()
    other = beside(one, 0.35, -0.5)
    depth = [render_body(BODY, s, cam).depth for s in (one, other)]
    own = np.isfinite(depth[0]) & (depth[0] <= depth[1])
    theirs = np.isfinite(depth[1]) & ~own
    both = np.where(own | theirs, np.minimum(*depth), 0.0).astype(np.float32)
    rig = Rig((cam,))
    scenes = [Scene(BODY, beside(s, 0.03, 0.04), rig) for s in (one, other)]
    return cam, both, own, theirs, scenes


def test_depth_is_the_body_it_is_nearest_to(pair):
    cam, both, own, theirs, (mine, yours) = pair
    sensor = DepthImageSensor("depth", cam, 0.01, SETTINGS, None)
    frame = DepthFrame("depth", 0.0, both)
    alone = sensor.prepare(frame, mine)
    parted = sensor.prepare(frame, mine.at(mine.state, others=(yours,)))
    assert np.mean(parted.depth[own] > 0) > 0.97 and np.mean(parted.depth[theirs] < 0) > 0.97
    assert np.mean(alone.depth[theirs] > 0) > 0.97, "with nobody else expected all is one's own"
    assert np.allclose(np.abs(parted.depth), np.abs(alone.depth)), "what is another's still hides what is behind it"
    assert (frame.depth == both).all()


def test_a_search_sees_nobody_else(pair):
    cam, both, _, theirs, (_, yours) = pair
    frame = DepthFrame("depth", 0.0, both)
    assert not without_others(frame, (yours,), cam).depth[theirs].any()
    assert without_others(frame, (), cam) is frame


def test_a_mask_of_everybody_gives_no_contour_between_people(pair):
    cam, both, own, theirs, (mine, yours) = pair
    sensor = SilhouetteSensor(cam, 2.0, SETTINGS)
    frame = SilhouetteFrame("depth", 0.0, (255 * (both > 0)).astype(np.uint8))
    whole = sensor.prepare(frame, mine)
    parted = sensor.prepare(frame, mine.at(mine.state, others=(yours,)))
    assert np.mean(whole.mask[theirs] > 0) > 0.9 and np.mean(parted.mask[theirs] > 0) < 0.15
    assert np.mean(parted.mask[own] > 0) > 0.9
    column, row = np.rint(parted.outline[:2]).astype(int)
    edge = np.array([theirs[max(r - 3, 0) : r + 4, max(c - 3, 0) : c + 4].any() for r, c in zip(row, column)])
    assert len(row) > 20 and edge.mean() < 0.1
