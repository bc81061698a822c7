"""Cycles are found where a movement repeats itself, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.exporters.report.cycles import find_cycles, gait_numbers, likeness, normalised
from kinefit.geometry import se3
from kinefit.simulation import known_motion, squat_and_wave

RATE, STRIDE, SPEED = 100.0, 1.1, 1.3  # [Hz], [s], [m/s]


def walk(seconds=6.0, *, speed=SPEED, stride=STRIDE, turn=0.4, swing=25.0):
    """A simple walk in a direction `turn` [rad], y up: the left leg half a stride after the right one."""
    body = load_body("humanoid")
    t = np.arange(round(seconds * RATE)) / RATE
    angles = np.zeros((len(t), len(body.tree.coordinates)))
    for side, late in (("r", 0.0), ("l", np.pi)):
        phase = 2 * np.pi * t / stride - late
        angles[:, body.tree.coordinate(f"hip_flexion_{side}")] = np.radians(5 + swing * np.cos(phase))
        angles[:, body.tree.coordinate(f"knee_angle_{side}")] = np.radians(swing * (1 - np.cos(phase - 1.9 * np.pi)))
    R = se3.exp_so3(np.array([0.0, turn, 0.0]))
    way = np.stack([speed * t, np.full(len(t), 0.95), 0 * t], axis=1) @ R.T
    return known_motion(body, RATE, se3.transform(R, way), angles, name="walk")


def test_a_walk_has_gait_cycles_of_its_stride():
    cycles = find_cycles(walk())
    assert cycles.kind == "gait" and [s.name for s in cycles.sides] == ["left", "right"]
    assert cycles.likeness > 0.99
    for side in cycles.sides:
        assert len(side.spans) >= 4
        assert np.allclose(np.diff(side.spans, axis=1) / RATE, STRIDE, atol=0.011)
        assert np.all((side.toe_off > 35) & (side.toe_off < 75))
    left, right = (s.spans[0, 0] for s in cycles.sides)
    assert abs(abs(left - right) % round(STRIDE * RATE) - STRIDE * RATE / 2) <= 1
    numbers = gait_numbers(walk(), cycles)
    for name, expected in (
        ("stride time [s]", STRIDE), ("cadence [steps/min]", 120 / STRIDE), ("speed [m/s]", SPEED),
        ("stride length [m]", SPEED * STRIDE),
    ):  # fmt: skip
        assert [of.mean for of in numbers[name]] == pytest.approx([expected] * 2, rel=0.02), name
        assert [of.spread for of in numbers[name]] == pytest.approx([0.0] * 2, abs=0.02 * expected), name


@pytest.mark.parametrize("up", ["x", "-y", "z"])
def test_the_vertical_axis_does_not_matter(up):
    a, b = find_cycles(walk()), find_cycles(walk().turned(up))
    for one, other in zip(a.sides, b.sides, strict=True):
        assert np.array_equal(one.spans, other.spans)


def test_on_a_treadmill_there_are_strides_without_length():
    cycles = find_cycles(walk(speed=0.0))
    assert cycles.kind == "gait"
    assert "stride time [s]" in gait_numbers(walk(speed=0.0), cycles)
    assert "speed [m/s]" not in gait_numbers(walk(speed=0.0), cycles)


def test_squats_repeat_without_being_gait():
    once = squat_and_wave(rate=50.0)
    n = 3
    thrice = known_motion(once.body, 50.0, np.tile(once.Ts_world_root, (n, 1, 1)), np.tile(once.angles, (n, 1)))
    cycles = find_cycles(thrice)
    assert cycles.kind == "repeated movement" and [s.name for s in cycles.sides] == ["both"]
    assert np.allclose(np.diff(cycles.sides[0].spans, axis=1), len(once), atol=2)
    assert list(gait_numbers(thrice, cycles)) == ["cycle time [s]"]


@pytest.mark.parametrize(
    "motion",
    [
        walk(1.2), walk(6.0, swing=2.0), squat_and_wave(), smooth_motion(200),
        replace(walk(), quality=np.zeros(600)), known_motion(load_body("arm"), 60.0, np.tile(np.eye(4), (90, 1, 1)),
                                                             np.zeros((90, len(load_body("arm").tree.coordinates)))),
    ],
    ids=["too short", "hardly moves", "once only", "irregular", "nobody seen", "still, without feet"],
)  # fmt: skip
def test_where_nothing_repeats_nothing_is_made_up(motion):
    assert find_cycles(motion) is None


def test_noise_alone_has_no_cycles():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        motion = walk(6.0, swing=0.0)
        noise = np.cumsum(rng.normal(0, 0.02, motion.angles.shape), axis=0)
        assert find_cycles(replace(motion, angles=motion.angles + noise)) is None


def test_a_cycle_in_which_nobody_was_seen_is_left_out():
    whole = find_cycles(walk())
    start, stop = whole.sides[1].spans[1]
    quality = np.ones(600)
    quality[(start + stop) // 2] = 0
    found = find_cycles(replace(walk(), quality=quality))
    assert len(found.sides[1].spans) == len(whole.sides[1].spans) - 1
    assert (start, stop) not in [tuple(span) for span in found.sides[1].spans]


def test_curves_are_taken_at_every_percent():
    values = np.arange(50.0)[:, None] * [1.0, -2.0]
    out = normalised(values, np.array([[0, 10], [20, 49]]))
    assert out.shape == (2, 101, 2)
    assert np.allclose(out[0, :, 0], np.linspace(0, 10, 101)) and np.allclose(out[1, :, 1], np.linspace(-40, -98, 101))


@given(st.integers(2, 6), st.floats(0.1, 10), st.floats(-5, 5))
def test_likeness_is_one_for_equal_curves_and_falls_with_noise(count, size, offset):
    course = offset + size * np.sin(np.linspace(0, 6, 101))
    same = np.tile(course, (count, 1))
    noise = np.random.default_rng(1).normal(0, size, same.shape)
    assert likeness(same) == pytest.approx(1.0)
    assert likeness(noise) < 0.5 < likeness(same + 0.3 * noise) < 1
    assert likeness(same[:1]) == 0.0 and likeness(0 * same) == 0.0


@pytest.mark.slow
def test_a_recorded_walk(data_dir):
    from kinefit.readers import read_bvh
    from kinefit.simulation import cut, resampled, retarget

    motion = retarget(read_bvh(data_dir("motion_cmu_bvh") / "cmu_12_01_walk.bvh"))
    motion = resampled(cut(motion, 6), 60.0)
    cycles = find_cycles(motion)
    assert cycles.kind == "gait" and cycles.likeness > 0.95
    numbers = gait_numbers(motion, cycles)
    for stance, cadence in zip(numbers["stance [% of cycle]"], numbers["cadence [steps/min]"], strict=True):
        assert 52 < stance.mean < 68 and 80 < cadence.mean < 130
