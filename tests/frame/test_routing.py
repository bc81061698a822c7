"""How sensors are made of frames."""

import numpy as np
import pytest
from tests.tracking.depth_oracle import BODY, camera, depth_of, facing

from kinefit.frame.routing import Sensors
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame
from kinefit.rendering import render_body
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

RIG = Rig((camera(),))
DOWN, AHEAD = facing(yaw=0.0), facing(yaw=0.0, arm_flex_r=85)


@pytest.mark.parametrize("rate, gathered", [(1.0, True), (30.0, False)])
def test_what_a_limb_may_have_moved_between_two_frames_is_gathered(rate, gathered):
    wrist = BODY.positions(AHEAD, BODY.landmarks.select(("r_wrist",)))[0]
    frame = DepthFrame("depth", 1.0, depth_of(BODY, AHEAD, RIG["depth"]))
    scene = Scene(BODY, DOWN, RIG)
    (measured,) = Sensors(RIG, rate, {}, TrackSettings()).measurements([frame], scene)
    cloud = measured.hints(scene).view.cloud
    assert (np.linalg.norm(cloud - wrist, axis=1).min() < 0.08) == gathered


def test_a_room_is_no_limb():
    wall = np.where(np.isfinite(shown := render_body(BODY, AHEAD, RIG["depth"]).depth), shown, 3.8)
    scene = Scene(BODY, DOWN, RIG)
    (measured,) = Sensors(RIG, 1.0, {}, TrackSettings()).measurements([DepthFrame("depth", 1.0, wall)], scene)
    (usual,) = Sensors(RIG, 30.0, {}, TrackSettings()).measurements([DepthFrame("depth", 1.0, wall)], scene)
    assert np.array_equal(measured.box, usual.box)


@pytest.mark.parametrize("rate, reach", [(120.0, 0.25), (10.0, 0.25), (5.0, 0.5), (1.0, 0.7), (0.01, 0.7)])
def test_the_reach_goes_with_the_time_between_frames(rate, reach):
    sensors, scene = Sensors(RIG, rate, {}, TrackSettings()), Scene(BODY, DOWN, RIG)
    sensors.measurements([DepthFrame("depth", 0.0, depth_of(BODY, DOWN, RIG["depth"]))], scene)
    assert sensors.of("depth").reach == pytest.approx(reach)


def test_a_longer_reach_that_is_asked_for_stays():
    sensors, scene = Sensors(RIG, 1.0, {}, TrackSettings(reach=1.0)), Scene(BODY, DOWN, RIG)
    sensors.measurements([DepthFrame("depth", 0.0, depth_of(BODY, DOWN, RIG["depth"]))], scene)
    assert sensors.of("depth").reach == 1.0
