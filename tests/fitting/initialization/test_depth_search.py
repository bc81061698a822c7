"""The search for a posture in a view."""

import numpy as np
from tests.fitting.tracking.depth_oracle import BODY, UP, camera, depth_of, facing

from kinefit.fitting.initialization.depth_search import PostureSearch
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


def test_a_limbs_tip_is_brought_to_an_end_of_the_surface_within_its_limits():
    state, cam = facing(), camera()
    depth = depth_of(BODY, state, cam)
    search = PostureSearch(BODY, view_of(depth, depth > 0, cam), UP, np.random.default_rng(0))
    limb = next(limb for limb in search.limbs if BODY.tree.segments[limb[-1]].startswith(("hand_r", "forearm_r")))
    tips = search._tips[limb[-1]]
    frames, _ = BODY.tree.forward(state.T_world_root, state.angles)

    def tip_of(angles, tip):
        f = BODY.tree.forward(state.T_world_root, angles)[0][limb[-1]]
        return (tip + BODY.tree.rest[limb[-1]]) @ f[:9].reshape(3, 3).T + f[9:]

    shoulder = BODY.tree.rest[limb[-2]] @ frames[limb[-2], :9].reshape(3, 3).T + frames[limb[-2], 9:]
    random = np.random.default_rng(1).normal(size=(20, 3))
    ends = shoulder + 0.3 * random / np.linalg.norm(random, axis=1, keepdims=True)
    angles = search._reaching(state, limb, ends)
    assert angles.shape == (40, len(state.angles))
    own = np.isin(BODY.tree.owners, limb)
    assert np.array_equal(angles[:, ~own], np.repeat(state.angles[None, ~own], 40, axis=0))
    assert (angles >= BODY.tree.lower - 1e-12).all() and (angles <= BODY.tree.upper + 1e-12).all()
    sight = (ends - search.view.viewpoint) / np.linalg.norm(ends - search.view.viewpoint, axis=1, keepdims=True)
    off = [np.linalg.norm(tip_of(a, tips[0]) - (e + 0.03 * s)) for a, e, s in zip(angles, ends, sight)]
    assert np.median(off) < 0.06  # some lie behind the back


def test_a_limb_beside_the_view_is_not_sought():
    state, cam = facing(), camera()
    depth = depth_of(BODY, state, cam)
    whole = PostureSearch(BODY, view_of(depth, depth > 0, cam), UP, np.random.default_rng(0))
    legs = [limb for limb in whole.limbs if BODY.tree.segments[limb[0]].startswith("thigh")]
    everything = tuple(range(len(BODY.tree.segments)))
    assert legs and not any(whole._is_out_of_view(state, limb, everything) for limb in legs)
    rows = np.flatnonzero((depth > 0).any(axis=1))
    depth[rows[0] + int(0.42 * len(rows)) :] = 0.0  # cut above the hips
    view = view_of(depth, depth > 0, cam)
    view.trust[np.flatnonzero(view.seen.any(axis=1))[-1] + 1 :] = 0.0
    half = PostureSearch(BODY, view, UP, np.random.default_rng(0))
    assert all(half._is_out_of_view(state, limb, everything) for limb in legs)
    arm = next(limb for limb in half.limbs if limb not in legs)
    assert not half._is_out_of_view(state, arm, everything)
