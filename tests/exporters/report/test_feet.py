"""Contacts and toe-offs of a recorded walk, on a floor and on a belt, and the numbers of its strides."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.exporters import write_c3d
from kinefit.exporters.report.cycles import find_cycles, gait_numbers
from kinefit.exporters.report.feet import _standing, foot_events
from kinefit.exporters.report.strides import Quantity, _Ground
from kinefit.readers.markers import read_markers
from kinefit.simulation import known_motion


@pytest.fixture(scope="module")
def recorded(data_dir):
    """(259 frames at 60 Hz) of a person who walks over a floor."""
    from kinefit.readers import read_bvh
    from kinefit.simulation import cut, resampled, retarget

    return resampled(cut(retarget(read_bvh(data_dir("motion_cmu_bvh") / "cmu_12_01_walk.bvh")), 6), 60.0)


def moved(motion, velocity):
    """The motion in a world that moves the other way."""
    roots = np.array(motion.Ts_world_root)
    roots[:, :3, 3] += motion.times[:, None] * velocity
    return replace(motion, Ts_world_root=roots)


@pytest.mark.parametrize("rate", [50.0, 120.0, 250.0])
def test_a_foot_stands_where_its_speed_passes_a_share_of_the_swings(rate):
    t = np.arange(0.0, 1.4, 1.0 / rate)
    swing = (t > 0.4) & (t < 0.8)
    speed = np.where(swing, 3.0 * np.sin(np.pi * (t - 0.4) / 0.4) ** 2, 0.0)  # [m/s], zero while it stands
    foot = np.stack([speed] * 3, axis=1)
    extremes = ((0.75, True), (0.42, False))
    contact, off = (_standing(foot, round(at * rate), rate, lands) / rate for at, lands in extremes)
    assert contact == pytest.approx(0.8 - 0.4 / np.pi * np.arcsin(np.sqrt(0.1)), abs=0.004)
    assert off == pytest.approx(0.4 + 0.4 / np.pi * np.arcsin(np.sqrt(0.18)), abs=0.004)
    assert _standing(np.full(foot.shape, 3.0), round(0.75 * rate), rate, True) is None  # it never stands


def test_feet_take_turns_and_stand_for_more_than_half_of_a_stride(recorded):
    feet = foot_events(recorded)
    assert np.array_equal(feet.belt, np.zeros(2))
    for foot, other in ((feet.left, feet.right), (feet.right, feet.left)):
        assert len(foot.contacts) >= 3 and np.all(foot.contact_std < 0.02) and np.all(foot.off_std[:-1] < 0.02)
        for start, stop in zip(foot.contacts, foot.contacts[1:]):
            assert np.sum((other.contacts > start) & (other.contacts < stop)) == 1
            (off,) = foot.offs[(foot.offs > start) & (foot.offs < stop)]
            assert 0.5 < (off - start) / (stop - start) < 0.7


@pytest.mark.parametrize("share", [0.8, 1.0, 1.2])
def test_on_a_treadmill_the_events_and_lengths_are_those_over_ground(recorded, share):
    way = recorded.Ts_world_root[-1, :3, 3] - recorded.Ts_world_root[0, :3, 3]
    belt = -share * way[::2] / (recorded.times[-1] - recorded.times[0])
    on_belt = moved(recorded, np.array([belt[0], 0.0, belt[1]]))
    feet, ground = foot_events(on_belt), foot_events(recorded)
    assert feet.belt == pytest.approx(belt, abs=0.1)
    for one, other in ((feet.left, ground.left), (feet.right, ground.right)):
        assert one.contacts == pytest.approx(other.contacts, abs=0.02)
        assert one.offs == pytest.approx(other.offs, abs=0.02)
    a, b = (gait_numbers(motion, find_cycles(motion)) for motion in (on_belt, recorded))
    for name in ("stride length [m]", "step length [m]"):
        assert [of.mean for of in a[name]] == pytest.approx([of.mean for of in b[name]], abs=0.15), name


@pytest.mark.parametrize("up", ["x", "-y", "z"])
def test_neither_the_vertical_axis_nor_the_clocks_start_matter(recorded, up):
    other = replace(recorded.turned(up), times=recorded.times + 2.5)
    a, b = foot_events(recorded), foot_events(other)
    assert b.left.contacts - 2.5 == pytest.approx(a.left.contacts, abs=1e-6)
    one, two = (gait_numbers(motion, find_cycles(motion)) for motion in (recorded, other))
    assert list(one) == list(two)
    for name in one:
        assert [q.mean for q in two[name]] == pytest.approx([q.mean for q in one[name]], abs=1e-6), name


def test_numbers_of_strides_agree_with_one_another(recorded):
    numbers = gait_numbers(recorded, find_cycles(recorded))
    for k in range(2):
        of = {name: each[k] for name, each in numbers.items()}
        assert of["stance [% of cycle]"].mean + of["swing [% of cycle]"].mean == pytest.approx(100.0)
        assert of["speed [m/s]"].values == pytest.approx(of["stride length [m]"].values / of["stride time [s]"].values)
        assert of["cadence [steps/min]"].values == pytest.approx(120.0 / of["stride time [s]"].values)
        assert 0.0 < of["step width [m]"].mean < 0.2
    both = sum(each.mean for each in numbers["step length [m]"])
    assert both == pytest.approx(np.mean([each.mean for each in numbers["stride length [m]"]]), abs=0.05)


def test_a_body_without_feet_has_no_events():
    arm = load_body("arm")
    still = known_motion(arm, 60.0, np.tile(np.eye(4), (90, 1, 1)), np.zeros((90, len(arm.tree.coordinates))))
    assert foot_events(still) is None


def test_slopes_of_landmarks_are_their_differences(recorded):
    ground, frame, step = _Ground(recorded, np.zeros(2)), 40, 1e-6
    direction, state = np.array([0.6, 0.0, 0.8]), recorded.state(frame)
    point = recorded.body.landmarks.select(("r_heel",))
    slopes = ground._slopes(point, frame, direction)
    found = np.zeros(len(slopes))
    for d in range(len(slopes)):
        moves = np.zeros(len(slopes))
        moves[d] = step
        ends = [recorded.body.positions(state.retract(sign * moves), point)[0] for sign in (1, -1)]
        found[d] = direction @ (ends[0] - ends[1]) / (2 * step)
    assert slopes == pytest.approx(found, abs=1e-6)


def test_deviations_of_places_add_up_over_feet_and_cancel_in_one_frame(recorded):
    motion = replace(recorded, joint_std=np.full(recorded.joint_std.shape, 0.01))
    ground, along = _Ground(motion, np.zeros(2)), np.array([0.0, 1.0])
    assert ground.std_of([("l_heel", 10, 1.0), ("r_heel", 60, -1.0)], along) == pytest.approx(0.01 * np.sqrt(2.0))
    assert ground.std_of([("l_heel", 10, 1.0), ("l_heel", 10, -1.0)], along) == pytest.approx(0.0, abs=1e-9)
    unknown = replace(motion, joint_std=np.full(recorded.joint_std.shape, np.inf))
    assert np.isinf(_Ground(unknown, np.zeros(2)).std_of([("l_heel", 10, 1.0)], along))


def test_a_quantity_that_was_never_seen_has_no_mean():
    none = Quantity(np.full(2, np.nan), np.full(2, np.nan))
    one = Quantity(np.array([1.0, np.nan]), np.array([0.1, np.nan]))
    assert np.isnan(none.mean) and np.isnan(none.std) and np.isnan(none.spread)
    assert one.mean == 1.0 and one.std == 0.1 and np.isnan(one.spread)


def test_events_are_in_a_c3d_file(recorded, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(recorded, tmp_path / "walk.c3d")
    events, feet = read_markers(tmp_path / "walk.c3d").events, foot_events(recorded)
    times = [e.time for e in events if (e.context, e.label) == ("Left", "Foot Strike")]
    assert times == pytest.approx(feet.left.contacts, abs=1e-5)
    group = ezc3d.c3d(str(tmp_path / "walk.c3d"))["parameters"]["EVENT"]
    assert group["USED"]["value"][0] == len(events) and set(group["LABELS"]["value"]) == {"Foot Strike", "Foot Off"}
    assert group["TIMES"]["value"][1] == pytest.approx([e.time for e in events], abs=1e-5)
