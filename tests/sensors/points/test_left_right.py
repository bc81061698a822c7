"""Left taken for right: found where it was done, and nowhere else."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import load_body
from kinefit.observations import Keypoints
from kinefit.sensors.channels import fitted_pixels, make_channels
from kinefit.sensors.points.views import find_swaps, limb_groups

BODY = load_body("humanoid")
SET = "BODY_25B"
NAMES = BODY.keypoints(SET).names
RIG = rig_around((0.0, 0.0, 0.0))


def scene(seed=0, noise=3.0):
    """A posture in four cameras: channels, its noisy pixels, weights, and its exact pixels."""
    random = np.random.default_rng(seed)
    state = posture(BODY, seed, 0.25)
    T = np.array(state.T_world_root)
    T[:3, 3] *= 0.2
    state = type(state)(T, state.angles)
    records = []
    for camera in RIG:
        uv = camera.project(BODY.positions(state, BODY.keypoints(SET)))
        uv = uv + noise * random.normal(size=uv.shape)
        records.append(Keypoints(camera.name, SET, NAMES, 25.0, uv[None, None], np.ones((1, 1, len(NAMES)))))
    channels = make_channels(BODY, RIG, records, [8.0] * 4)
    return channels, np.array(channels.uv[0]), channels.weight[0].copy(), fitted_pixels(BODY, channels, state)


def test_limbs_swap_together():
    channels, *_ = scene()
    groups = dict(zip([channels.points.names[c] for c in channels.column], limb_groups(BODY, channels), strict=True))
    assert groups["LKnee"] == groups["RKnee"] == groups["LHeel"] == groups["RBigToe"]
    assert groups["LWrist"] == groups["RShoulder"] == groups["LEye"] == groups["Nose"]
    assert groups["LKnee"] != groups["LWrist"]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_found_where_nothing_was_exchanged(seed):
    channels, uv, weight, fitted = scene(seed)
    assert not find_swaps(channels, limb_groups(BODY, channels), uv, weight, fitted).any()


@pytest.mark.parametrize("camera", range(4))
@pytest.mark.parametrize("what", ["all", "legs", "arms"])
def test_an_exchange_is_found_and_undone(camera, what):
    found_at_all = 0
    for seed in range(5):
        channels, uv, weight, fitted = scene(seed)
        groups = limb_groups(BODY, channels)
        names = [channels.points.names[c] for c in channels.column]
        limb = {"legs": groups[names.index("LKnee")], "arms": groups[names.index("LWrist")]}
        mine = (channels.camera == camera) & ((what == "all") | (groups == limb.get(what)))
        paired = channels.partner != np.arange(len(uv))
        spoilt = np.where(mine[:, None], uv[channels.partner], uv)
        found = find_swaps(channels, groups, spoilt, weight, fitted)
        assert not found[~(mine & paired)].any()
        matters = np.linalg.norm(uv - uv[channels.partner], axis=1)  # seen from the side the two are at one place
        for group in np.unique(groups[mine]):
            here = mine & paired & (groups == group)
            if np.sum(matters[here] > 40) >= 4:
                assert np.all(found[here])
                found_at_all += 1
    assert found_at_all >= 3


def test_what_was_not_seen_has_no_say():
    channels, uv, weight, fitted = scene(1)
    groups = limb_groups(BODY, channels)
    mine = channels.camera == 2
    spoilt = np.where(mine[:, None], uv[channels.partner], uv)
    lost = np.random.default_rng(0).random(len(uv)) < 0.3
    spoilt[lost], weight[lost] = np.nan, 0.0
    found = find_swaps(channels, groups, spoilt, weight, fitted)
    assert not found[~mine].any() and found[mine].any()
    nothing = find_swaps(channels, groups, np.full_like(uv, np.nan), np.zeros(len(uv)), fitted)
    assert not nothing.any()


def test_sides_that_are_known_stay():
    channels, uv, weight, fitted = scene(1)
    groups, mine = limb_groups(BODY, channels), channels.camera == 2
    other = np.where((mine | (channels.camera == 1))[:, None], uv[channels.partner], uv)
    found = find_swaps(channels, groups, other, weight, fitted, mine)
    assert not found[mine].any() and found[channels.camera == 1].any()


def test_one_wild_point_is_no_exchange():
    channels, uv, weight, fitted = scene(2)
    n = [channels.points.names[c] for c in channels.column].index("LWrist")
    uv[n] = fitted[channels.partner[n]]  # one wrist on the other: an outlier, not the body's other side
    assert not find_swaps(channels, limb_groups(BODY, channels), uv, weight, fitted).any()


def test_a_point_in_the_middle_is_never_exchanged():
    channels, uv, weight, fitted = scene(3)
    spoilt = uv[channels.partner]
    found = find_swaps(channels, limb_groups(BODY, channels), spoilt, weight, fitted)
    middle = channels.partner == np.arange(len(uv))
    assert middle.any() and not found[middle].any() and found.any()
