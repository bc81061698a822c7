"""The gait record: pooled walks, symmetry, turns, and what is no walk."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.report.test_cycles import RATE, STRIDE, walk

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.exporters.gait.record import gait_record, headings, straight_cycles, symmetry
from kinefit.exporters.report.strides import Quantity
from kinefit.geometry import se3
from kinefit.simulation import cut, known_motion, squat_and_wave


@pytest.fixture(scope="module")
def recorded(data_dir):
    """(259 frames at 60 Hz) of a person who walks over a floor."""
    from kinefit.readers import read_bvh
    from kinefit.simulation import resampled, retarget

    return resampled(cut(retarget(read_bvh(data_dir("motion_cmu_bvh") / "cmu_12_01_walk.bvh")), 6), 60.0)


def reversed_in_time(motion):
    return replace(motion, Ts_world_root=motion.Ts_world_root[::-1], angles=motion.angles[::-1])


def turned_about(motion, angle):
    """The motion whose world turns about the vertical (F,) [rad]."""
    R = se3.exp_so3(np.outer(angle, [0.0, 1.0, 0.0]))
    return replace(motion, Ts_world_root=se3.transform(R, np.zeros((len(angle), 3))) @ motion.Ts_world_root)


def test_walks_are_put_together(recorded):
    one, two = gait_record({"a": recorded}), gait_record({"a": recorded, "b": recorded})
    for side in ("left", "right", "both"):
        a, b = (record.quantities(side) for record in (one, two))
        assert list(a) == list(b)
        for name in a:
            assert len(b[name].values) == 2 * len(a[name].values)
            assert (b[name].mean, b[name].std) == pytest.approx((a[name].mean, a[name].std))
    assert [walk.name for walk in two.walks] == ["a", "b"] and not two.notes
    assert len(straight_cycles(two)) == sum(one.kind == "stride" for one in two.stretches)


def test_a_single_step_counts():
    motion = walk(1.45)
    record = gait_record({"a": motion})
    assert record.count("stride", "left", "straight") + record.count("stride", "right", "straight") == 0
    steps = record.quantities("both")
    assert steps["step time [s]"].mean == pytest.approx(STRIDE / 2, abs=0.03)
    assert steps["step length [m]"].mean == pytest.approx(1.3 * STRIDE / 2, rel=0.1)
    assert any("single steps alone" in note for note in record.notes)
    assert straight_cycles(record) == []


def test_steps_within_strides_do_not_count_twice(recorded):
    record = gait_record({"a": recorded})
    ends = [(one.side, one.stop) for one in record.stretches]
    assert len(set(ends)) == len(ends)


def test_a_limp_survives():
    even, limp = (gait_record({"a": motion}) for motion in (walk(), limping()))
    for record, least, most in ((even, -6.0, 6.0), (limp, 10.0, 60.0)):
        sides = [record.quantities(side)["step time [s]"] for side in ("left", "right")]
        value, std = symmetry(*sides)
        assert least < value < most and std > 0.0


def limping(late=0.08):
    """A walk whose left leg is behind by a share of the stride."""
    motion = walk()
    shift = round(late * STRIDE * RATE)
    angles = np.array(motion.angles)
    left = [d for d, c in enumerate(motion.body.tree.coordinates) if c.endswith("_l")]
    angles[shift:, left] = motion.angles[:-shift, left]
    return cut(replace(motion, angles=angles), shift, len(motion))


def test_turns_are_told_from_straight_walking(recorded):
    angle = np.interp(recorded.times, [0.0, 2.2, 4.3], [0.0, 0.0, 2.0])
    record = gait_record({"a": turned_about(recorded, angle)})
    kinds = {one.walk for one in record.stretches}
    assert kinds == {"straight", "turning"} and record.walk == "straight"
    assert all(one.walk == "turning" for one in record.stretches if one.start > 2.6)
    alone = gait_record({"a": turned_about(recorded, 1.2 * recorded.times)})
    assert alone.walk == "turning" and alone.quantities("both", "turning")


def test_curves_do_not_depend_on_the_way_of_the_walk(recorded):
    across = gait_record({"a": turned_about(recorded, np.full(len(recorded), 1.5))})
    for (one, cycles), (other, _) in zip(
        straight_cycles(gait_record({"a": recorded})), straight_cycles(across), strict=True
    ):
        assert one.Ts_world_root[:, :3, :3] == pytest.approx(other.Ts_world_root[:, :3, :3], abs=1e-6)
        assert headings(one).mean() == pytest.approx(0.0, abs=1e-6)
        assert cycles.sides[0].spans.tolist() == [[0, len(one) - 1]]


def test_walking_backwards_is_a_walk(recorded):
    forward, back = gait_record({"a": recorded}), gait_record({"a": reversed_in_time(recorded)})
    assert any("backwards" in note for note in back.notes) and not forward.notes
    for name in ("stride time [s]", "stride length [m]", "step width [m]", "stance [% of cycle]"):
        a, b = (record.quantities("both")[name].mean for record in (forward, back))
        assert b == pytest.approx(a, rel=0.15, abs=0.03), name
    a, b = (record.quantities("both")["foot progression [deg]"].mean for record in (forward, back))
    assert b == pytest.approx(a, abs=6.0)


def test_one_leg_alone_has_strides_but_no_steps(recorded):
    quality = np.array(recorded.segment_quality)
    for name in ("thigh_l", "shank_l", "foot_l", "toes_l"):
        quality[:, recorded.body.tree.segments.index(name)] = 0.0
    record = gait_record({"a": replace(recorded, segment_quality=quality)})
    assert {one.side for one in record.stretches} == {"right"}
    assert "stance [% of cycle]" in record.quantities("right") and "step time [s]" not in record.quantities("right")
    assert any("only the right leg was measured" in note for note in record.notes)


def test_ends_without_the_person_are_left_out_and_said(recorded):
    quality = np.array(recorded.quality)
    quality[:20] = quality[-15:] = 0.0
    record = gait_record({"a": replace(recorded, quality=quality)})
    assert len(record.walks[0].motion) == len(recorded) - 35
    assert f"frames before 20 and after {len(recorded) - 16}" in record.notes[0]
    assert min(one.start for one in record.stretches) >= recorded.times[20]


def sitting():
    """A person in a wheelchair, who rolls ahead."""
    body, t = load_body("humanoid"), np.arange(300) / RATE
    angles = np.tile(body.tree.usual, (len(t), 1))
    for side in "lr":
        angles[:, body.tree.coordinate(f"hip_flexion_{side}")] = np.radians(90)
        angles[:, body.tree.coordinate(f"knee_angle_{side}")] = np.radians(90)
    return known_motion(body, RATE, se3.transform(np.eye(3), np.outer(t, [0.8, 0.0, 0.0]) + [0, 0.5, 0]), angles)


@pytest.mark.parametrize(
    ("motion", "reason"),
    [(sitting, "sits"), (lambda: squat_and_wave(), "no foot steps"), (lambda: replace(walk(), up="z"), "z is not up"),
     (lambda: replace(walk(), quality=np.zeros(600)), "no person was observed"),
     (lambda: cut(walk(), 0, 30), "no (foot|two)"),
     (lambda: known_motion(load_body("arm"), RATE, np.tile(np.eye(4), (9, 1, 1)), np.zeros((9, 6))), "no landmarks")],
)  # fmt: skip
def test_what_is_no_walk_has_no_record_and_the_reason_is_said(motion, reason):
    with pytest.raises(ObservationError, match=reason) as told:
        gait_record({"trial": motion()})
    assert told.value.file == "trial" and told.value.remedy


def test_a_motion_that_is_no_walk_is_left_out_of_others(recorded):
    record = gait_record({"walk": recorded, "chair": replace(sitting(), body=recorded.body)})
    assert [walk.name for walk in record.walks] == ["walk"]
    assert any("chair is left out: the person sits" in note for note in record.notes)


def test_people_are_not_mixed(recorded):
    small = recorded.body.scaled(np.full(len(recorded.body.scale_groups), 0.8))
    with pytest.raises(ObservationError, match="two people: the legs in anna and ben differ by 25 %"):
        gait_record({"anna": recorded, "ben": replace(recorded, body=small)})
    named = [replace(recorded, provenance={"session": {"subject": name}}) for name in ("P01", "P02")]
    with pytest.raises(ObservationError, match=r"2 people: P01 \(a\) and P02 \(b\)"):
        gait_record(dict(zip("ab", named)))


def test_a_child_has_a_childs_steps():
    motion = walk()
    small = motion.body.scaled(np.full(len(motion.body.scale_groups), 0.65))
    roots = np.array(motion.Ts_world_root)
    roots[:, :3, 3] *= 0.65
    child = gait_record({"a": replace(motion, body=small, Ts_world_root=roots)})
    adult = gait_record({"a": motion})
    a, b = (record.quantities("both")["stride length [m]"].mean for record in (adult, child))
    assert b == pytest.approx(0.65 * a, rel=0.02)


def test_symmetry_is_a_share_of_the_mean():
    left, right = Quantity(np.array([1.1]), np.array([0.02])), Quantity(np.array([0.9]), np.array([0.02]))
    value, std = symmetry(left, right)
    assert value == pytest.approx(20.0)
    ends = [symmetry(Quantity(left.values + d, left.stds), Quantity(right.values + e, right.stds))[0] for d, e in
            ((1e-6, 0.0), (-1e-6, 0.0), (0.0, 1e-6), (0.0, -1e-6))]  # fmt: skip
    slopes = np.array([ends[0] - ends[1], ends[2] - ends[3]]) / 2e-6
    assert std == pytest.approx(0.02 * np.linalg.norm(slopes), rel=1e-4)
