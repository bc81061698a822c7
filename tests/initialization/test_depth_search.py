"""The search for a posture in a view."""

import numpy as np
from tests.tracking.depth_oracle import BODY, UP, camera, depth_of, facing

from kinefit.initialization.depth_search import PostureSearch
from kinefit.sensors.surfaces.depth_view import view_of


def test_one_who_faced_away_a_moment_ago_rather_still_does():
    state, cam = facing(yaw=np.pi), camera()
    depth = depth_of(BODY, state, cam)
    view, random = view_of(depth, depth > 0, cam), np.random.default_rng(0)
    about = np.array(state.T_world_root)
    about[:3, [0, 2]] *= -1.0  # turned about the vertical
    roots = np.stack([state.T_world_root, about])
    unknown = PostureSearch(BODY, view, UP, random).stance(roots)
    known = PostureSearch(BODY, view, UP, random, state.T_world_root[:3, 0]).stance(roots)
    assert unknown[0] > unknown[1], "of two that look alike, the one that faces the sensor"
    assert known[0] < 0.01 < 0.15 < known[1]
