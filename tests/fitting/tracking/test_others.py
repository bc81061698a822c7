"""Other people whose motions are known: where they are at a time."""

from dataclasses import replace

import numpy as np
from tests.fitting.tracking.movements import BODY, a_motion, a_rig

from kinefit.fitting.tracking.run import OtherPeople


def test_somebody_is_where_the_motion_has_him_at_that_time():
    motion, rig = a_motion(), a_rig()
    others = OtherPeople((motion,), rig, 0.5 / motion.rate)
    (scene,) = others.at(float(motion.times[3]) + 0.3 / motion.rate)
    assert np.allclose(scene.state.T_world_root, motion.Ts_world_root[3]) and scene.body is motion.body
    assert others.at(float(motion.times[-1]) + 1.0) == []


def test_a_body_without_surfaces_hides_nothing():
    motion = replace(a_motion(), body=replace(BODY, surfaces=()))
    assert OtherPeople((motion,), a_rig(), 1.0).at(float(motion.times[0])) == []
