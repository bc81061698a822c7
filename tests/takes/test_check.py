"""A check of recordings with one known mistake each, and of one without."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kinefit.findings import Finding, listed, ranked
from kinefit.fitting.multiview.views import make_views, with_sides_right
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.observations.recordings import mirror_name
from kinefit.rigs.diagnostics.cameras import camera_biases, disagreement, frame_findings, without_points
from kinefit.rigs.diagnostics.checks import check_keypoints
from kinefit.rigs.diagnostics.rig import lens_findings, placement_findings
from kinefit.simulation import (
    DepthSensor,
    cut,
    in_front,
    simulate_depth,
    simulate_keypoints,
    squat_and_wave,
    studio_rig,
)
from kinefit.takes.check import check_take

MOTION = cut(squat_and_wave(duration=2.0), 0, 60)
RIG = studio_rig(MOTION)
SEEN = simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.1, missing=0.1, seed=1)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def posed(change, only=None):
    """The rig with changed poses: change(T_camera_world)."""
    return Rig(tuple(c.with_pose(change(c.T_camera_world)) if only in (None, c.name) else c for c in RIG))


def renamed(*names):
    """The keypoints with other cameras' names."""
    return [replace(k, camera=name) for k, name in zip(SEEN, names, strict=True)]


def mirrored(axis):
    def turn(points):
        out = points.copy()
        out[..., axis] = RIG.cameras[0].size[axis] - 1 - out[..., axis]
        return out

    return [replace(k, points=turn(k.points)) for k in SEEN]


def one_reversed(camera, axes, *, sides):
    """One camera's keypoints in a picture that is reversed, where a detector may take left for right."""
    def turn(record):
        points = record.points.copy()
        for axis in axes:
            points[..., axis] = RIG[camera].size[axis] - 1 - points[..., axis]
        other = [record.names.index(mirror_name(n) or n) for n in record.names] if sides else slice(None)
        return replace(record, points=points[:, :, other], confidence=record.confidence[:, :, other])

    return [turn(k) if k.camera == camera else k for k in SEEN]


def kinds(check, severity="fault"):
    return [found.kind for found in check.findings if found.severity == severity]


def test_a_recording_without_mistakes_has_none():
    check = check_keypoints(RIG, SEEN)
    assert kinds(check) == kinds(check, "doubt") == kinds(check, "note") == []
    looked_at = {"lens", "bias", "time", "sides", "placement", "up", "floor", "scale", "coverage"}
    assert set(kinds(check, "good")) == looked_at
    assert max(b.size for b in check.biases) < 0.5
    assert all(c.volume == 1.0 for c in check.coverage)


TURNED = se3.transform(se3.exp_so3(np.array([0.0, np.radians(0.8), 0.0])), np.zeros(3))
OTHER = np.random.default_rng(1)
ELSEWHERE = Rig(tuple(
    c.with_pose(c.T_camera_world @ se3.transform(se3.exp_so3(OTHER.normal(0, 0.12, 3)), OTHER.normal(0, 0.4, 3)))
    for c in RIG
))  # fmt: skip
MISTAKES = {
    "exchanged": (RIG, renamed("cam03", "cam02", "cam01", "cam04"), "swapped", "rename cam01 to cam03"),
    "three exchanged": (RIG, renamed("cam02", "cam03", "cam01", "cam04"), "swapped", "rename cam01 to cam03"),
    "camera to world": (posed(se3.inverse), SEEN, "poses", "from world to camera"),
    "graphics axes": (posed(lambda T: FLIP @ T), SEEN, "poses", "y down"),
    "graphics, inverted": (posed(lambda T: se3.inverse(FLIP @ T)), SEEN, "poses", "y down"),
    "left-handed world": (RIG, mirrored(1), "mirrored", "right-handed"),
    "selfie pictures": (RIG, mirrored(0), "mirrored", "hflip"),
    "one selfie picture": (RIG, one_reversed("cam02", (0,), sides=True), "mirrored", "cam02 was recorded mirrored"),
    "one mirrored table": (RIG, one_reversed("cam03", (0,), sides=False), "mirrored", "cam03 was recorded mirrored"),
    "one upside down": (RIG, one_reversed("cam01", (0, 1), sides=False), "turned", "rotation = 180"),
    "floor as ceiling": (RIG.moved(FLIP), SEEN, "up", 'up = "-z"'),
    "another session": (ELSEWHERE, SEEN, "session", "another session"),
    "millimetres": (
        posed(lambda T: se3.transform(T[:3, :3], 1000 * T[:3, 3])), SEEN, "scale", 'unit = "mm"',
    ),
    "nobody in one": (RIG, [replace(k, points=k.points * np.nan, confidence=0 * k.confidence)
                            if k.camera == "cam03" else k for k in SEEN], "coverage", "video and keypoints"),
    "nobody at all": (RIG, [replace(k, points=k.points * np.nan, confidence=0 * k.confidence) for k in SEEN], "nobody",
                      "are of this recording"),
}  # fmt: skip


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("case", MISTAKES)
def test_a_gross_mistake_is_the_only_fault_and_the_remedy_names_what_to_do(case, quick):
    rig, keypoints, kind, remedy = MISTAKES[case]
    check = check_keypoints(rig, keypoints, quick=quick)
    assert kinds(check) == [kind]
    assert remedy in check.faults[0].remedy


def test_wrong_axis_for_up():
    check = check_keypoints(RIG, SEEN, up="y")
    assert kinds(check) == ["up"]
    assert 'up = "z"' in check.faults[0].remedy


def test_a_camera_that_was_turned_is_named_and_its_shift_told():
    rig = posed(lambda T: TURNED @ T, only="cam02")
    check = check_keypoints(rig, SEEN)
    assert kinds(check) == ["moved"]
    moved = check.faults[0]
    assert moved.cameras == ("cam02",)
    assert all(found.severity == "note" for found in check.findings if found.kind == "bias")
    assert moved.confidence.startswith("Likely")
    c = rig.index("cam02")
    told = disagreement(check.views).solve(c)[0]
    assert told[:2] == pytest.approx([np.radians(0.8) * RIG["cam02"].matrix[0, 0], 0.0], abs=1.5)
    alone = check.biases[c].alone
    assert alone == pytest.approx([23.4, 0.0], abs=2.0)  # what the turn moves the picture by


def test_a_wrong_focal_length_is_told_as_a_scale():
    K = np.array(RIG["cam03"].matrix)
    K[0, 0] *= 1.03
    K[1, 1] *= 1.03
    rig = Rig(tuple(replace(c, matrix=K) if c.name == "cam03" else c for c in RIG))
    check = check_keypoints(rig, SEEN)
    moved = next(found for found in check.findings if found.kind == "moved")
    assert (moved.severity, moved.cameras) == ("doubt", ("cam03",))
    assert "focal length" in moved.text
    assert disagreement(check.views).solve(2)[0, 3] == pytest.approx(0.03 / 1.03, abs=0.003)


def test_points_are_taken_out_as_by_solving_for_them_too():
    random = np.random.default_rng(0)
    J, D, r = random.normal(size=(5, 8, 3)), random.normal(size=(5, 8, 4)), random.normal(size=(5, 8))
    matrix, right = without_points(J, D, r)
    whole = np.zeros((40, 19))
    for n in range(5):
        whole[8 * n : 8 * n + 8, :4], whole[8 * n : 8 * n + 8, 4 + 3 * n : 7 + 3 * n] = D[n], J[n]
    expected = np.linalg.lstsq(whole, r.ravel(), rcond=None)[0][:4]
    assert np.linalg.solve(matrix.sum(0), right.sum(0)) == pytest.approx(expected, rel=1e-6)


def test_exchanged_sides_are_put_right_in_their_frames():
    swapped = simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.1, missing=0.1, swaps=0.4, seed=2)
    mixed = [s if s.camera == "cam02" else k for k, s in zip(SEEN, swapped, strict=True)]
    views = with_sides_right(make_views(RIG, mixed))
    plain = make_views(RIG, simulate_keypoints(MOTION, RIG, noise_px=0.0, outliers=0.0, missing=0.0))
    off = np.nanmedian(np.linalg.norm(views.uv - plain.uv, axis=-1), axis=1)
    assert off.max() < 10
    assert views.swapped.sum(axis=0).tolist() == [0, 24, 0, 0]
    check = check_keypoints(RIG, mixed)
    assert not kinds(check)
    assert "left and right in 24 of 60 frames of cam02" in next(f.text for f in check.findings if f.kind == "sides")


def test_biases_of_two_cameras_have_nothing_to_compare_with():
    views = make_views(RIG, SEEN).select(("cam01", "cam02"))
    biases = camera_biases(views)
    assert all(np.isnan(b.alone).all() for b in biases)
    assert not kinds(check_keypoints(views.rig, SEEN[:2]))


def camera(**changes):
    K = np.array([[1000.0, 0, 639.5], [0, 1000.0, 359.5], [0, 0, 1]])
    return Camera(**({"name": "a", "size": (1280, 720), "matrix": K, "distortion": np.zeros(4)} | changes))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"matrix": np.array([[64e3, 0, 639.5], [0, 64e3, 359.5], [0, 0, 1]])}, "implausible"),
        ({"matrix": np.array([[200.0, 0, 639.5], [0, 200.0, 359.5], [0, 0, 1]])}, "implausible"),
        ({"matrix": np.array([[1000.0, 0, 639.5], [0, 1300.0, 359.5], [0, 0, 1]])}, "not square"),
        ({"matrix": np.array([[1000.0, 0, 200.0], [0, 1000.0, 359.5], [0, 0, 1]])}, "principal point"),
        ({"distortion": np.array([-1.5, 0, 0, 0])}, "not invertible"),
    ],
)
def test_lenses_that_cannot_be_are_told(changes, told):
    assert not [f for f in lens_findings(Rig((camera(),))) if f.severity == "doubt"]
    found = [f for f in lens_findings(Rig((camera(**changes),))) if f.severity == "doubt"]
    assert len(found) == 1
    assert told in found[0].text


def looking(name, centre):
    """A camera at a place, that looks at (0, 0, 1)."""
    z = np.array([0.0, 0.0, 1.0]) - centre
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return camera(name=name, T_camera_world=se3.transform(R, -R @ np.asarray(centre)))


POINTS = np.random.default_rng(0).normal([0, 0, 1], 0.3, (50, 3))


@pytest.mark.parametrize(("place", "word"), [((4.0, 0.3, 1.0), "side by side"), ((-4.0, 0.1, 1.0), "face each other")])
def test_cameras_beside_or_opposite_each_other_matter_unless_others_see_the_depth(place, word):
    two = Rig((looking("a", (4.0, 0.0, 1.0)), looking("b", place)))
    found = placement_findings(two, POINTS)
    assert [f.severity for f in found] == ["doubt"]
    assert word in found[0].text
    three = Rig((*two, looking("c", (0.0, 4.0, 1.5))))
    assert not [f for f in placement_findings(three, POINTS) if f.severity == "doubt"]


@pytest.mark.parametrize("told", ["video", "calibration"])
def test_keypoints_told_in_the_wrong_picture_are_found_and_read_in_the_other(told):
    views = make_views(RIG, SEEN)
    images = {name: ImageFrame.identity() for name in RIG.names}
    images["cam01"] = images["cam02"] = ImageFrame.scaled((1088, 1920), (720, 1280))
    frames = dict.fromkeys(RIG.names, told)
    assert frame_findings(views, images, frames) == ([], views)
    uv = views.uv.copy()
    for c in (0, 1):  # as they are read where the take tells the wrong picture
        change = images["cam01"].to_calibration if told == "video" else images["cam01"].from_calibration
        uv[:, :, c] = change(uv[:, :, c])
    found, right = frame_findings(replace(views, uv=uv), images, frames)
    assert [(f.severity, f.cameras) for f in found] == [("fault", ("cam01", "cam02"))]
    assert ('frame = "calibration"' in found[0].remedy) == (told == "video")
    np.testing.assert_allclose(right.uv, views.uv, atol=1e-9)


def test_findings_are_ranked_and_listed():
    mixed = [Finding(s, s, "") for s in ("good", "note", "fault", "doubt")]
    assert [f.severity for f in ranked(mixed)] == ["fault", "doubt", "note", "good"]
    assert (listed(["a"]), listed("ab"), listed("abc"), listed([])) == ("a", "a and b", "a, b and c", "none")


SHIPPED = """
[take]
up = "z"
[calibration]
file = "{folder}/calibration/Calib.qca.txt"
"""
CAMERA = """
[[camera]]
name = "{name}"
video = "{folder}/videos/{name}.mp4"
[[keypoints]]
camera = "{name}"
file = "{folder}/mediapipe_landmarks_{name}.npy"
format = "mediapipe"
frame = "video"
"""


def test_the_real_trial_as_it_was_shipped(data_dir, tmp_path):
    folder = data_dir("video_balancing_4cam").as_posix()
    names = ("cam01", "cam02", "cam03", "cam04")
    text = SHIPPED.format(folder=folder) + "".join(CAMERA.format(folder=folder, name=name) for name in names)
    (tmp_path / "take.toml").write_text(text)
    check = check_take(tmp_path / "take.toml")
    boxed = [f for f in check.findings if f.kind == "letterboxed"]
    assert [f.cameras for f in boxed] == [("cam01",), ("cam02",)]
    assert all(f.severity == "fault" and 'image = "letterboxed"' in f.remedy for f in boxed)
    biased = {f.cameras[0] for f in check.faults if f.kind == "bias"}
    assert biased == {"cam01", "cam03"}
    assert check.biases[0].bias[0] < -10
    moved = next(f for f in check.findings if f.kind == "moved")
    assert moved.cameras == ("cam01", "cam03")
    swapped = check.views.swapped.sum(axis=0)
    assert 26 <= swapped[1] <= 31
    assert swapped.sum() == swapped[1]
    assert not [f for f in check.findings if f.kind in ("up", "scale", "coverage") and f.severity != "good"]


@pytest.mark.parametrize("over", [False, True])
def test_a_depth_camera_alone_that_hangs_upside_down_is_named(tmp_path, over):
    sensor = DepthSensor("depth", (128, 96), 110.0, 0.5, 5.5, (0.004, 0.0008, 0.0), holes=0.01)
    motion = squat_and_wave(rate=1.0, duration=2.0, up="y")
    front = in_front(motion, sensor.camera(), azimuth=0.3, near=sensor.near, far=sensor.far)
    video = simulate_depth(motion, front, sensor, room=False, seed=1)
    for i in range(len(video)):
        image = np.round(1e3 * video.frame(i).depth).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), image[::-1, ::-1] if over else image)
    K = front.matrix
    (tmp_path / "take.toml").write_text(
        f'[take]\nrate = 1.0\nup = "-y"\n[[depth]]\nname = "front"\nfile = "*.png"\nunit = 0.001\n'
        f"intrinsics = [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\n"
    )
    check = check_take(tmp_path / "take.toml")
    assert [(f.kind, f.cameras) for f in check.faults] == ([("up", ("front",))] if over else [])
    for found in check.faults:
        assert "front is upside down" in found.text and 'up = "y"' in found.remedy
