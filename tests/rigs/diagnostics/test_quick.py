"""What `track` always looks at: faults of the inputs in a second of work, and none where there are none."""

from dataclasses import replace

import numpy as np
import pytest

import kinefit
from kinefit import Recording, load_body, track
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import TrackingError
from kinefit.findings import FINDINGS, INVERTED, NOTES, Finding, faults_of, of_provenance
from kinefit.fitting.multiview.views import make_views, sample
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.rigs.diagnostics.checks import check_keypoints
from kinefit.rigs.diagnostics.quick import input_findings, motion_findings, with_cause, with_findings
from kinefit.rigs.diagnostics.timing import group_findings
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

MOTION = squat_and_wave(duration=4.0)  # 120 frames
RIG = studio_rig(MOTION)
SEEN = simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.1, missing=0.1, seed=1)


def quick(rig=RIG, keypoints=SEEN, **more):
    """Kinds, cameras and texts of the faults that a quick check finds."""
    return check_keypoints(rig, keypoints, quick=True, **more).faults


def changed(change, only=None):
    """The rig with some cameras changed."""
    return Rig(tuple(change(c) if only in (None, c.name) else c for c in RIG))


def translated(factors):
    return lambda c: c.with_pose(se3.transform(c.T_camera_world[:3, :3], factors * c.T_camera_world[:3, 3]))


def zoomed(factor):
    return lambda c: replace(c, matrix=c.matrix * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]]))


def turned(degrees):
    turn = se3.transform(se3.exp_so3(np.radians([0.0, degrees, 0.0])), np.zeros(3))
    return lambda c: c.with_pose(turn @ c.T_camera_world)


def test_right_inputs_have_no_fault_however_few_cameras():
    assert quick() == ()
    for names in (("cam01", "cam02"), ("cam01", "cam03", "cam04")):
        assert quick(RIG.select(names), [k for k in SEEN if k.camera in names]) == ()


X = np.array([-1.0, 1.0, 1.0])
CASES = {
    "world too large": (changed(translated(1.8)), {}, "scale", (), "about 1.8 times"),
    "world too small": (changed(translated(0.5)), {}, "scale", (), "write height"),
    "inches for metres": (changed(translated(39.37)), {}, "scale", (), 'write unit = "inch"'),
    "metres for millimetres": (changed(translated(1e-3)), {}, "scale", (), 'unit = "m", not "mm"'),
    "a wrong height": (RIG, {"height": 1.2}, "scale", (), "Check height in [take]"),
    "another vertical": (RIG, {"up": "x"}, "up", (), 'up = "z"'),
    "focal lengths halved": (changed(zoomed(0.5)), {}, "focal", (), "correct fx and fy"),
    "one focal length doubled": (changed(zoomed(2.0), "cam03"), {}, "focal", ("cam03",), "the lenses of cam03"),
    "a sign": (changed(translated(X), "cam02"), {}, "poses", ("cam02",), "Correct the sign"),
    "a camera that was turned far": (changed(turned(8.0), "cam04"), {}, "stranger", ("cam04",), "cam04 was moved far"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_number_is_the_only_fault_with_its_cause_and_camera(case):
    rig, more, kind, cameras, remedy = CASES[case]
    found = quick(rig, **more)
    assert [(f.kind, f.cameras) for f in found] == [(kind, cameras)]
    assert remedy in found[0].remedy


def test_a_child_is_no_fault_where_the_take_states_the_height():
    small = changed(translated(0.6))
    assert [f.kind for f in quick(small)] == ["scale"]
    assert quick(small, height=0.6 * load_body("humanoid").stature) == ()


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.2])
def test_a_person_of_a_size_that_few_adults_have_is_questioned(scale):
    """1.36 m and 2.1 m: `check` doubts it, `track` says so; not where the take states the height."""
    body = load_body("humanoid")
    person = replace(MOTION, body=body.scaled(np.full(len(body.scale_groups), scale)))
    told = with_findings(person, (), Nothing, None).provenance.get(NOTES)
    doubts = [f for f in check_keypoints(changed(translated(scale)), SEEN).findings if f.kind == "scale"]
    assert [f.severity for f in doubts] == ["good" if scale == 1.0 else "doubt"]
    assert (told is None) == (scale == 1.0)
    if told:
        assert f"{person.body.stature:.2f} m tall" in told[0] and "a child" in told[0] and "board" in told[0]
        assert "height = " in told[0] and doubts[0].remedy in told[0]
    assert NOTES not in with_findings(person, (), Nothing, 1.36).provenance


def test_a_large_scale_of_a_lens_is_not_taken_for_a_unit():
    """All focal lengths halved make a person of twice the size, where the cameras look at her middle."""
    found = quick(changed(zoomed(0.5)))
    assert "half those that fit the keypoints" in found[0].text


def test_exchanged_names_of_left_and_right_show_in_face_toes_and_knees():
    from kinefit.observations.recordings import mirror_name

    def exchanged(k):
        order = [k.names.index(mirror_name(n) or n) for n in k.names]
        return replace(k, points=k.points[:, :, order], confidence=k.confidence[:, :, order])

    found = quick(keypoints=[exchanged(k) for k in SEEN])
    assert [f.kind for f in found] == ["mirrored"]
    assert "swap the names of left and right" in found[0].remedy
    without = [replace(k, confidence=np.where([n.endswith(("ear", "heel", "foot_index")) for n in k.names], 0.0,
                                              exchanged(k).confidence), points=exchanged(k).points)
               for k in SEEN]  # fmt: skip
    assert [f.kind for f in quick(keypoints=without)] == ["mirrored"]  # by the knees alone


@pytest.mark.parametrize("whole", [True, False])
def test_points_of_little_confidence_are_said_before_cameras_are_blamed(whole):
    weak = [replace(k, confidence=0.25 * k.confidence / k.confidence.max()) for k in SEEN]
    found = check_keypoints(RIG, weak, quick=not whole).findings
    assert [(f.kind, f.cameras) for f in faults_of(found)] == [("coverage", (name,)) for name in RIG.names]
    assert all(f"in {c} with a confidence above 0.3 (highest: 0.25)" in f.text for f, c in zip(found, RIG.names))


def test_samples_of_nothing_are_empty():
    views = make_views(RIG, SEEN)
    assert sample(views.select([])).shape[1:] == (0, 2)
    assert sample(views.at(np.zeros(0, int))).shape == (0, 4, 2)


@pytest.mark.parametrize("seed", range(3))
def test_points_in_another_order_are_no_wrong_scale(seed):
    order = np.random.default_rng(seed).permutation(len(SEEN[0].names))
    seen = [replace(k, points=k.points[:, :, order], confidence=k.confidence[:, :, order]) for k in SEEN]
    found = quick(keypoints=seen)
    assert found[0].kind == "set" and f"not those of {SEEN[0].keypoint_set}" in found[0].text
    assert "scale" not in {f.kind for f in found}


def parted(who):
    """Cameras that from the middle on show what they did show in the beginning, half as fast."""
    half = len(SEEN[0]) // 2
    order = np.concatenate([np.arange(half), np.arange(half) // 2 + 13])
    return [replace(k, points=k.points[order], confidence=k.confidence[order]) if k.camera in who else k for k in SEEN]


@pytest.mark.parametrize("who", [("cam03", "cam04"), ("cam01", "cam03")])
def test_two_cameras_that_go_on_with_another_motion_are_told_with_their_frames(who):
    found = quick(keypoints=parted(who))
    assert [f.kind for f in found] == ["groups"]
    assert "in frames 80 to 119; in frames 0 to 39 all cameras show the same motion" in found[0].text
    assert "frames = [0, 40]" in found[0].remedy
    others = tuple(n for n in RIG.names if n not in who)
    assert {found[0].cameras[:2], found[0].cameras[2:]} == {who, others}
    assert "frames = [100, 140]" in group_findings(RIG, parted(who), first=100)[0].remedy


def test_cameras_out_of_step_all_the_time_are_no_groups():
    late = [k.rows(slice(8, None) if k.camera in ("cam01", "cam02") else slice(0, -8), 0.0) for k in SEEN]
    assert group_findings(RIG, late) == []
    assert group_findings(RIG, SEEN) == []


BENDING = dict(zip(RIG.names, (-0.35, 0.2, 0.15, -0.3), strict=True))  # k1


def test_distortion_that_was_left_out_is_named_with_its_cameras():
    def wide(c):
        narrow = c.matrix * np.array([[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]])
        near = se3.transform(c.T_camera_world[:3, :3], c.T_camera_world[:3, 3] * np.array([1.0, 1.0, 0.5]))
        return replace(c, matrix=narrow, T_camera_world=near, distortion=np.array([BENDING[c.name], 0, 0, 0]))

    rig = changed(wide)
    seen = simulate_keypoints(MOTION, rig, noise_px=3.0, outliers=0.1, missing=0.1, seed=1)
    assert quick(rig, seen) == ()
    found = quick(Rig(tuple(replace(c, distortion=np.zeros(4)) for c in rig)), seen)
    assert [f.kind for f in found] == ["distortion"]
    assert {"cam01", "cam04"} <= set(found[0].cameras)
    assert "cam04 as if k1 were -0.3" in found[0].text


def with_up(motion, up):
    return replace(motion, up=up)


def walking(motion, way):
    """The same motion, carried along."""
    Ts = motion.Ts_world_root.copy()
    Ts[:, :3, 3] += np.linspace(0, 1, len(motion))[:, None] * way
    return replace(motion, Ts_world_root=Ts)


def test_a_person_who_hangs_head_down_or_walks_lying_has_a_wrong_vertical():
    up = MOTION.up
    other = next(axis for axis in UP_AXES if abs(np.dot(UP_AXES[axis], UP_AXES[up])) < 0.5)
    assert motion_findings(MOTION, None) == ()
    walk = walking(MOTION, 2.0 * np.array(UP_AXES[other]))
    assert motion_findings(walk, None) == ()
    assert motion_findings(with_up(MOTION, other), None) == ()  # who keeps the place may lie
    lying = motion_findings(with_up(walk, other), None)
    assert [f.kind for f in lying] == ["up"]
    assert f'up = "{up}"' in lying[0].remedy
    inverted = motion_findings(with_up(MOTION, up[1:] if up.startswith("-") else f"-{up}"), None)
    assert [f.kind for f in inverted] == ["up"]
    lost = replace(walk, quality=np.full(len(walk), 0.2), up=other)
    assert motion_findings(lost, None) == ()  # it is not known how the person is placed


def test_a_depth_camera_that_hangs_upside_down_is_named_with_the_line_to_write():
    class Depth:
        keypoints, markers, depth, clouds = (), (), (1,), ()

    upright = with_findings(MOTION, (), Depth, None)
    turned = with_findings(replace(MOTION, provenance={INVERTED: "front"}), (), Depth, None)
    assert not of_provenance(upright.provenance)
    (found,) = of_provenance(turned.provenance)
    assert found.kind == "up" and found.cameras == ("front",) and "upside down" in found.text
    opposite = MOTION.up[1:] if MOTION.up.startswith("-") else f"-{MOTION.up}"
    assert f'up = "{opposite}"' in found.remedy


def test_findings_are_kept_in_provenance_and_damaged_ones_are_none():
    found = (Finding("fault", "scale", "The person would be 3 m tall.", ("cam01",), "Sure.", "Check the unit."),)
    motion = with_findings(MOTION, found, Nothing, None)
    assert of_provenance(motion.provenance) == found
    assert motion.provenance[FINDINGS][0]["remedy"] == "Check the unit."
    assert of_provenance({}) == of_provenance({FINDINGS: [{"kind": 3}]}) == of_provenance({FINDINGS: 1}) == ()
    assert faults_of([*found, *found, Finding("doubt", "time", "late")]) == found


class Nothing:
    """What no sensor saw."""

    keypoints = markers = depth = clouds = ()


def test_an_error_of_tracking_tells_the_fault_as_its_cause():
    error = TrackingError("the person is not found in the first 60 steps", remedy="Check units.")
    assert with_cause(error, ()) is error
    told = with_cause(error, (Finding("fault", "scale", "The person would be 3 mm tall.", remedy="Write unit."),))
    assert isinstance(told, TrackingError)
    assert str(told) == (
        "the person is not found in the first 60 steps; the inputs have a fault: The person would be 3 mm tall. "
        "Write unit."
    )


def test_a_camera_that_sees_other_people_alone_is_no_fault(tmp_path, copy_take):
    take = copy_take(tmp_path)
    entry = kinefit.read_take(take)
    seen = kinefit.load_observations(entry)
    gone = [replace(k, points=k.points * np.nan, confidence=0.0 * k.confidence) if k.camera == "cam03" else k
            for k in seen.keypoints]  # fmt: skip
    body = load_body("humanoid")
    assert input_findings(entry, seen, gone, body) == ()
    nobody = input_findings(entry, replace(seen, keypoints=tuple(gone)), gone, body)
    assert [(f.kind, f.cameras) for f in nobody] == [("coverage", ("cam03",))]


def test_a_camera_that_is_late_by_part_of_a_slow_frame_is_named_with_the_line_to_write(tmp_path, copy_take):
    """Six frames a second: half a frame is 83 ms. At 30 a second it is no matter for `track`."""
    entry = kinefit.read_take(copy_take(tmp_path))
    motion = squat_and_wave(duration=12.0)
    rig = studio_rig(motion)
    views = simulate_keypoints(motion, rig, noise_px=3.0, seed=1)

    def found(step, late):
        slow = [replace(k.rows(slice(late if k.camera == "cam02" else 0, 355, step), 0.0), rate=30.0 / step)
                for k in views]  # fmt: skip
        length = min(len(k) for k in slow)
        slow = [k.rows(slice(0, length), 0.0) for k in slow]
        seen = replace(kinefit.load_observations(entry), rig=rig, keypoints=tuple(slow))
        return input_findings(entry, seen, slow, load_body("humanoid"))

    (late,) = found(5, 3)
    assert late.severity == "doubt" and late.cameras == ("cam02",) and faults_of([late]) == ()
    assert found(5, 0) == found(1, 1) == ()
    provenance = with_findings(MOTION, (late,), Nothing, None).provenance
    (sentence,) = provenance[NOTES]
    assert "time_offset = 0." in sentence and "cam02" in sentence and provenance[FINDINGS] == []
    assert NOTES not in with_findings(MOTION, (), Nothing, None).provenance
    error = TrackingError("lost")
    assert with_cause(error, (late,)) is error


def test_track_take_keeps_what_it_found(tmp_path, copy_take):
    take = copy_take(tmp_path)
    text = take.read_text()
    take.write_text(text.replace("[take]\n", "[take]\nframes = [0, 12]\n"))
    motion, _ = kinefit.track_take(take, smooth=False)
    assert motion.provenance[FINDINGS] == []
    take.write_text(take.read_text().replace("[take]\n", "[take]\nheight = 1.2\n"))
    motion, _ = kinefit.track_take(take, smooth=False)
    assert [f.kind for f in of_provenance(motion.provenance)] == ["scale"]
    recording = Recording.of_keypoints(RIG, [k.rows(slice(0, 12), 0.0) for k in SEEN])
    assert FINDINGS not in track(recording, load_body("humanoid"), smooth=False).provenance  # in memory: the caller's
