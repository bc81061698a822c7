"""How far every joint moved: the numbers of the table are those of the curves, with their deviations."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.report.test_page import own
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies.lasting_errors import LastingErrors, ParameterErrors
from kinefit.bodies.motion import BRIEF_S
from kinefit.exporters.report.angles import MAX_STD_DEG, all_ranges, extremes, range_changes, ranges_of, ranges_table
from kinefit.exporters.tables import NAMES, Curve, curves

RATE = 50.0
TIMES = np.arange(101) / RATE
MOTION = smooth_motion(101, RATE)
MOTION = replace(MOTION, dof_std=np.full_like(MOTION.dof_std, np.radians(2.0)))
KNEE = 6 + MOTION.body.tree.coordinate("knee_angle_l")


def curve(std=2.0, values=None):
    values = 30 + 20 * np.sin(2 * np.pi * TIMES) if values is None else values
    std = np.broadcast_to(std, values.shape).astype(float)
    return Curve("knee_angle_l", "knee", "left", "deg", values, std, np.nan, (KNEE,), np.full((101, 1), 180 / np.pi))


def test_of_a_sine_its_ends_range_and_speed():
    found = extremes(curve(), MOTION, np.ones(101, bool))
    assert found.lowest == pytest.approx((10.0, 4.0), abs=0.05)
    assert found.highest == pytest.approx((50.0, 4.0), abs=0.05)
    assert found.span == pytest.approx((40.0, 4 * 2**0.5), abs=0.1)
    assert found.fastest[0] == pytest.approx(20 * 2 * np.pi, rel=0.01) and found.share == 1.0
    assert np.isnan(found.fastest[1])  # nobody told it
    assert extremes(replace(curve(), speed_std=3.0), MOTION, np.ones(101, bool)).fastest[1] == 6.0


def test_what_was_not_observed_takes_no_part():
    values = curve().values.copy()
    values[40:50] = 500.0
    std = np.full(101, 2.0)
    std[40:50] = np.inf
    found = extremes(curve(std, values), MOTION, np.ones(101, bool))
    assert found.highest[0] < 51 and found.fastest[0] < 150 and found.share == pytest.approx(91 / 101)
    tracked = np.arange(101) < 20
    assert extremes(curve(), MOTION, tracked).lowest[0] == pytest.approx(30.0)
    assert extremes(curve(MAX_STD_DEG), MOTION, np.ones(101, bool)) is None


@pytest.mark.parametrize(("segment", "part"), [("shank_l", True), ("thigh_l", True), ("foot_l", False)])
def test_frames_in_which_a_limb_is_lost_take_no_part(segment, part):
    motion = smooth_motion(40)
    quality, angles = np.ones((40, len(motion.body.tree.segments))), np.array(motion.angles)
    angles[10:20, list(motion.body.tree.coordinates).index("knee_angle_l")] += np.radians(100.0)
    quality[8:22, motion.body.tree.segment(segment)] = 0.1
    std = np.full_like(motion.dof_std, 0.01)
    found = ranges_of(replace(motion, quality=np.ones(40), segment_quality=quality, dof_std=std, angles=angles))
    knee = found["knee_angle"]["left"]
    assert knee.share == pytest.approx(26 / 40 if part else 1.0) and (knee.span[0] < 90.0) == part
    assert found["knee_angle"]["right"].share == 1.0


def test_what_both_ends_have_in_common_is_not_in_the_range():
    motion = smooth_motion(40)
    motion = replace(motion, quality=np.ones(40), dof_std=np.full_like(motion.dof_std, np.radians(5.0)))
    n = motion.dof_std.shape[1]
    shared = np.full((1, n, 1), np.radians(4.0))
    known = replace(motion, lasting=LastingErrors(np.array([0]), shared, np.zeros((1, n, 0)), 0.3))
    before, after = (ranges_of(m)["knee_angle"]["left"] for m in (motion, known))
    assert before.span[1] == pytest.approx(2 * 5 * 2**0.5) and after.lowest == before.lowest
    low, high = after.ends
    brief = 1 - np.exp(-abs(motion.times[high] - motion.times[low]) / BRIEF_S)
    assert after.span[1] == pytest.approx(2 * 3 * (2 * brief) ** 0.5)
    assert "± 14" in own(ranges_table(motion))
    tilt, common = (ranges_of(m)["pelvis_tilt"][""] for m in (motion, known))
    assert tilt.span[0] == common.span[0] and 0 < common.span[1] < 0.8 * tilt.span[1]
    alone, less = (next(r for r in all_ranges(m) if r.name == "knee flexion").difference for m in (motion, known))
    assert alone[1] == pytest.approx(2 * 5 * 4**0.5) and less[1] < 0.7 * alone[1] and less[0] == alone[0]  # four ends


def test_the_table_has_left_beside_right_and_says_what_is_unknown():
    motion = smooth_motion(40)
    motion = replace(motion, quality=np.ones(40), dof_std=np.full_like(motion.dof_std, 0.01))
    text = own(ranges_table(motion))
    assert text.count("<table>") == 2 and "not observed" not in text
    blind = np.array(motion.dof_std)
    blind[:, 6 + list(motion.body.tree.coordinates).index("knee_angle_l")] = np.inf
    rows = own(ranges_table(replace(motion, dof_std=blind))).split("<tr>")
    knee = next(row for row in rows if "Knee flexion" in row)
    assert knee.count("not observed") == 1 and knee.count("±") == 3  # of the right knee
    assert {c.stem for c in curves(motion) if c.unit == "deg"} <= set(NAMES)


def test_the_highest_speed_has_the_uncertainty_that_smoothing_told():
    motion = smooth_motion(40)
    motion = replace(motion, quality=np.ones(40), dof_std=np.full_like(motion.dof_std, 0.01))
    speeds = dict.fromkeys(motion.body.dof_names, 0.1) | {"knee_angle_r": 0.2}
    motion = replace(motion, provenance={"smoothing": {"speed_std": speeds}})
    found = {c.name: c.speed_std for c in curves(motion)}
    assert found["knee_angle_r"] == pytest.approx(np.degrees(0.2))
    assert found["pelvis_tilt"] == pytest.approx(np.degrees(0.1)) and found["pelvis_tx"] == pytest.approx(0.1)
    rows = own(ranges_table(motion)).split("<tr>")
    knee = next(row for row in rows if "Knee flexion" in row)
    assert knee.count("±") == 8 and "± 23" in knee and "± 11" in knee


def test_ranges_of_all_angles_by_side():
    motion = smooth_motion(20)
    found = ranges_of(motion)
    assert set(found["knee_angle"]) == {"left", "right"} and set(found["lumbar_extension"]) == {""}
    (knee,) = (c for c in curves(motion) if c.name == "knee_angle_l")
    assert found["knee_angle"]["left"].span[0] == pytest.approx(np.ptp(knee.values))
    blind = replace(motion, quality=np.zeros(len(motion)))
    assert all(one is None for sides in ranges_of(blind).values() for one in sides.values())


def test_a_change_lacks_the_errors_that_two_takes_of_a_person_share():
    motion = smooth_motion(40)
    motion = replace(motion, quality=np.ones(40), dof_std=np.full_like(motion.dof_std, np.radians(5.0)))
    n = motion.dof_std.shape[1]
    constant = np.radians(3.0) * np.ones((1, n, 1)) * np.linspace(-1.0, 1.0, 40)[:, None, None]
    constant = np.concatenate([constant, np.zeros((40, n, 1))], axis=2)  # of the thigh's length, and of the shank's

    def of(values, names=("thigh", "shank")):
        """The thigh as the prior has it, the shank measured."""
        covariance, directions = np.diag([1.0, 1e-6]), np.diag([1.0, 1e-3])
        known = ParameterErrors(names, np.array(values), covariance, np.eye(2), directions)
        return replace(motion, lasting=LastingErrors(np.arange(40), constant, np.zeros((40, n, 0)), 0.3, known))

    before, after = of([0.0, 0.4]), of([0.0, 0.4])
    key = ("knee_angle", "left")
    alone = range_changes(before, replace(after, lasting=replace(after.lasting, parameters=None)))[key]
    assert alone.change[1] == pytest.approx(np.hypot(alone.before.span[1], alone.after.span[1]))
    low, high = alone.before.ends
    constant_deg = 3.0 * abs(high - low) * 2 / 39
    shared = range_changes(before, after)[key]
    assert shared.change == (0.0, pytest.approx((alone.change[1] ** 2 - 8 * constant_deg**2) ** 0.5))
    assert range_changes(before, of([0.0, -1.0]))[key].change[1] == pytest.approx(alone.change[1])  # somebody else
    assert range_changes(before, of([0.0, 0.4], ("l", "r")))[key].change[1] == pytest.approx(alone.change[1])
    wider = np.array(motion.angles)
    column = list(motion.body.tree.coordinates).index("knee_angle_l")
    wider[:, column] *= 2.0
    more = range_changes(before, replace(after, angles=wider))[key]
    assert more.change[0] == pytest.approx(shared.before.span[0]) and more.is_clear == (more.change[0] > more.change[1])
    blind = np.array(motion.dof_std)
    blind[:, 6 + column] = np.inf
    unseen = range_changes(before, replace(after, dof_std=blind))[key]
    assert unseen.change is None and unseen.after is None and not unseen.is_clear
