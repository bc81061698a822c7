"""People by their colours: parts of the body, one before another, others before it, and what cannot be told."""

import numpy as np
import pytest
from tests.sensors.painted_people import BODY, RIG, WALL, frames, image, person

from kinefit.bodies.rendering import render_body
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.images.regions import RegionSettings
from kinefit.observations import ColourFrame
from kinefit.sensors.regions.region_parts import AROUND, Parts
from kinefit.sensors.regions.regions import RegionSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

FRONT = RIG["front"]
SEGMENT = {name: k for k, name in enumerate(BODY.tree.segments)}
BEFORE = {"arm_flex_r": 20.0, "arm_rot_r": 60.0, "elbow_flex_r": 80.0}  # the right forearm before the trunk


def measured(state, camera=FRONT, others=(), **options):
    """A measurement by a sensor that saw the person at this state, and the scene."""
    scene = Scene(BODY, state, RIG, others=others)
    sensor = RegionSensor(camera, None, TrackSettings())
    return sensor.prepare(ColourFrame(camera.name, 0.0, image(state, camera, **options)), scene), scene


def tracker(state, rig=RIG, **settings):
    t = Tracker(BODY, rig, rate=30.0, settings=TrackSettings(**settings), up="y")
    t.start_at(state)
    return t


def joints(state):
    """(S, 3) [m] of the joint that each segment hangs on."""
    f = BODY.tree.forward(state.T_world_root, state.angles)[0]
    return np.einsum("sij,sj->si", f[:, :9].reshape(-1, 3, 3), BODY.tree.rest) + f[:, 9:]


def wrong(found, truth):
    """(S,) [m] how far joint centres are off."""
    return np.linalg.norm(joints(found.state) - joints(truth), axis=1)


def test_parts_are_segments_of_both_sides_and_places_lie_on_one_part():
    mesh = Scene(BODY, person(), RIG).surface.morphing.mesh
    parts = Parts(BODY, mesh, 40, True)
    group = {name: int(parts.group[k]) for name, k in SEGMENT.items()}
    assert group["thigh_r"] == group["thigh_l"] != group["shank_r"] and parts.count == 12
    assert parts.joined[group["forearm_r"], group["upperarm_r"]] and not parts.joined[group["hand_r"], group["thigh_r"]]
    assert not parts.joined[-1, :-1].any() and parts.joined[-1, -1]
    of_vertex = np.zeros(len(mesh.vertices), int)
    of_vertex[mesh.faces.ravel()] = np.repeat(parts.label, 3)
    np.testing.assert_array_equal(parts.of[parts.anchor], of_vertex)
    whole = Parts(BODY, mesh, 40, False)
    assert whole.count == 1 and len(np.unique(whole.anchor)) == 40


def test_an_arm_before_the_trunk_is_compared_with_it():
    m, scene = measured(person(**BEFORE))
    rim = m.rim(scene)
    lines = m.of.parts(scene).lines(rim, m._drawn(scene))
    limb = [SEGMENT["forearm_r"], SEGMENT["hand_r"]]
    before = np.isin(rim.segment, limb) & (lines.beyond != AROUND)
    assert before.sum() >= 10 and (lines.anchor[before] == -1).all()
    trunk = m.of.parts(scene).group[[SEGMENT["abdomen"], SEGMENT["thorax"], SEGMENT["pelvis"]]]
    assert np.isin(lines.beyond[before], trunk).mean() > 0.7
    assert (lines.anchor[lines.beyond == AROUND] >= 0).all()
    # skin before a shirt: inwards the lines say skin, outwards shirt
    told = m.profiles(scene, rim, 1)[before]
    assert np.median(told[:, 10:12]) > 0.5 and np.median(told[:, 12:14]) < -0.5


def test_an_arm_that_moves_before_the_trunk_is_followed_where_parts_have_colours():
    there = {**BEFORE, "arm_rot_r": 45.0, "elbow_flex_r": 95.0}
    off = []
    for parts in (True, False):
        t = tracker(person(**BEFORE), Rig((FRONT,)), regions=RegionSettings(parts=parts))
        for k in range(6):
            share = min(k / 3.0, 1.0)
            at = person(**{name: (1 - share) * BEFORE[name] + share * there[name] for name in there})
            found = t.update(frames(at, k / 30, Rig((FRONT,)), seed=k))
        pixel = [FRONT.project(joints(s)) for s in (found.state, at)]
        off.append(np.linalg.norm(pixel[0] - pixel[1], axis=1)[SEGMENT["hand_r"]])
    assert off[0] < 4.0 and off[1] > 2.0 * off[0]


def test_a_person_is_followed_in_two_views():
    t = tracker(person())
    for k in range(8):
        at = person(hip_flexion_r=10 + 3.0 * k, knee_angle_r=20 + 4.0 * k, arm_add_l=-15 - 4.0 * k)
        found = t.update(frames(at, k / 30, seed=k))
    off = wrong(found, at)
    assert np.median(off) < 0.008 and off.max() < 0.03
    assert found.quality > 0.8 and not found.lost.any()


def test_pixels_of_another_body_tell_nothing():
    """Somebody stands before the person's right half: where that one is known to be, no contour is looked for."""
    state, other = person(), person(at=(0.7, 0.0, 0.2))
    hiding = Scene(BODY, other, RIG)
    mask = render_body(BODY, other, FRONT).seen

    def near(others):
        m, here = measured(state, people=((other, (220, 60, 200)),), others=others)
        rim = m.rim(here)
        u, v = np.rint(rim.outline[:2]).astype(int)
        assert ((m._drawn(here).face == -2).sum() > 200) == bool(others)
        return mask[v, u].mean(), m.evidence(here)

    (covered, told), (seen, _) = near((hiding,)), near(())
    assert seen > 0.1 and covered < 0.02
    assert told.quality[SEGMENT["shank_r"]] > 0.8


def test_a_limb_that_is_elsewhere_is_told_and_not_learnt_from_and_the_rest_is():
    """The right arm is raised, and thought to hang: what is known of arms stays, what is known of legs is renewed."""
    m, scene = measured(person())
    sensor, there = m.of, image(person(arm_add_r=-110.0), FRONT, seed=1)
    later = sensor.prepare(ColourFrame("front", 0.1, there), scene)
    told = later.evidence(scene)
    arm, gone = SEGMENT["forearm_r"], told.lost | told.hidden
    assert gone[arm] and told.quality[arm] < 0.5
    assert told.quality[SEGMENT["thigh_l"]] > 0.7 and told.quality[SEGMENT["head"]] > 0.7
    before, parts = sensor.colours, sensor.parts(scene)
    sensor.learn(later, scene, False)
    forearm, colours = parts.group[arm], there.reshape(-1, 3)[::7].astype(int) >> 3
    number = (colours[:, 0] << 10) | (colours[:, 1] << 5) | colours[:, 2]
    green = np.unique(sensor.bins[number[colours[:, 1] > colours[:, 0] + 2]])  # squares of the wall
    assert len(green) > 3 and before.near[green].sum() > 0.2
    assert sensor.colours.inside[forearm, green].sum() < before.inside[forearm, green].sum() + 0.01
    thigh = parts.group[SEGMENT["thigh_r"]]
    assert not np.array_equal(sensor.colours.inside[thigh], before.inside[thigh])


def test_a_limb_of_the_walls_colour_is_not_told():
    """Forearms and hands in the wall's one colour: nothing holds them, and quality says so; the rest is seen."""
    plain = {"paint": {"forearm": WALL[0], "hand": WALL[0]}, "wall": (WALL[0], WALL[0])}
    aside, rig = person(arm_add_r=-70.0, arm_add_l=-70.0), Rig((FRONT,))
    t = tracker(aside, rig)
    for k in range(3):
        found = t.update(frames(aside, k / 30, rig, seed=k, **plain))
    for name in ("hand_r", "hand_l", "forearm_r", "forearm_l"):
        assert found.hidden[SEGMENT[name]] or found.segment_quality[SEGMENT[name]] < 0.5
    assert found.segment_quality[SEGMENT["thorax"]] > 0.7


def test_a_jump_of_light_is_told_and_its_colours_are_not_learnt_blindly():
    """No colour is any more what it was: all is hidden. When the light is back the person is found again."""
    t, told = tracker(person()), []
    for k in range(10):
        told.append(t.update(frames(person(), k / 30, seed=k, light=0.72 if k in (4, 5) else 1.0)))
        if k == 3:
            before = t.sensors.of("region front").colours.images
        if k == 5:
            assert t.sensors.of("region front").colours.images == before
    assert all(r.quality < 0.3 and (r.hidden | r.lost).mean() > 0.9 for r in told[4:6])
    assert told[3].quality > 0.8 and told[-1].quality > 0.8
    assert wrong(told[-1], person()).max() < 0.03


def test_light_may_change():
    t = tracker(person())
    for k in range(8):
        found = t.update(frames(person(), k / 30, seed=k, light=1.0 - 0.03 * k))
    assert wrong(found, person()).max() < 0.03 and found.quality > 0.8


def test_out_of_view_nothing_is_known():
    t = tracker(person(at=(0.0, 0.0, 30.0)))
    found = t.update(frames(person()))
    assert found.hidden.all() and found.quality == 0.0 and (found.joint_std[1:].max(axis=1) > 0.3).all()


def test_equal_colours_everywhere_hide_all_of_it():
    t = tracker(person())
    grey = [ColourFrame(c.name, 0.0, np.full((260, 220, 3), 120, np.uint8)) for c in RIG]
    found = t.update(grey)
    assert found.hidden.all() and found.quality == 0.0


@pytest.mark.parametrize("sigma", [None, 2.0])
def test_simple_shapes_are_trusted_less_than_a_mesh(sigma):
    sensor = RegionSensor(FRONT, sigma, TrackSettings())
    sensor.prepare(ColourFrame("front", 0.0, image(person(), FRONT)), Scene(BODY, person(), RIG))
    assert sensor.sigma == pytest.approx(sigma or 0.01 * 260.0 / 2.4, rel=0.05)
