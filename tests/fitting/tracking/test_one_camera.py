"""One camera alone: a take of one video without calibration, whose detections were lifted to space by a network."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import TakeError, TrackingError
from kinefit.exporters.motion_file import write_detections, write_motion
from kinefit.fitting.smoothing.foot_contacts import soles
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.geometry import se3
from kinefit.observations import MEDIAPIPE_33, Detections
from kinefit.readers.landmarks.detections import read_detections
from kinefit.readers.take.cameras import DEFAULT_FIELD_OF_VIEW
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import squat_and_wave
from kinefit.takes.batch.corrections import add_click
from kinefit.takes.in_view import people_in_view
from kinefit.takes.track import track_take

SIZE, RATE = (720, 1280), 30.0
HEAD = f"[take]\nrate = {RATE}\n"
CAMERA = '[[camera]]\nname = "phone"\nsize = [720, 1280]\n'
DETECTED = '[[keypoints]]\ncamera = "phone"\nformat = "detect"\nfile = "phone.npz"\n'


def tilted(T):
    """The truth's world as a telephone has it that was held 8 degrees downwards and taken to look level."""
    return se3.transform(se3.exp_so3(np.radians([8.0, 0.0, 0.0])), np.zeros(3)) @ T


def truth():
    """A person of 1.75 m who squats and waves, three metres and a half before the camera, turned by 35 degrees."""
    motion = squat_and_wave(rate=RATE, up="z")
    c, s = np.cos(np.radians(125.0)), np.sin(np.radians(125.0))
    T = np.array([[c, -s, 0, 0.1], [s, c, 0, 3.5], [0, 0, 1, -1.0], [0, 0, 0, 1.0]])
    return motion, T


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Pixels with 3 px of noise, and landmarks that are off by 6 cm in depth for as long as the take lasts."""
    folder = tmp_path_factory.mktemp("phone")
    (folder / "take.toml").write_text(HEAD + "height = 1.75\n" + CAMERA + DETECTED)
    write_phone(folder / "phone.npz", truth()[1])
    return folder


def write_phone(path, T, size=1.0, metres=0.95, depth_error=0.06):
    """Detections of the person, so many times as large and as far away, and a network's metres of all that."""
    motion, rng = truth()[0], np.random.default_rng(1)
    x = motion.positions(motion.body.keypoints("MEDIAPIPE_33").select(MEDIAPIPE_33)) @ T[:3, :3].T + T[:3, 3]
    focal = 0.5 * max(SIZE) / np.tan(np.radians(DEFAULT_FIELD_OF_VIEW) / 2)
    own = np.stack([x[..., 0], -x[..., 2], x[..., 1]], axis=-1)  # along u, v and away
    uv = focal * own[..., :2] / own[..., 2:] + (np.array(SIZE) - 1) / 2 + rng.normal(scale=3.0, size=(*x.shape[:2], 2))
    hips = own[:, [MEDIAPIPE_33.index(n) for n in ("left_hip", "right_hip")]].mean(axis=1, keepdims=True)
    lifted = size * metres * (own - hips)
    lifted[..., 2] += rng.normal(scale=depth_error, size=33)
    nothing = np.zeros(0, np.uint32), np.zeros(len(x) + 1, int)
    sure = np.full((len(x), 1, 33), 0.9)
    write_detections(
        Detections("phone", RATE, SIZE, uv[:, None], sure, *nothing, lifted=lifted[:, None]), path
    )  # fmt: skip


def test_a_person_is_followed_in_space_by_one_camera(folder):
    motion, seen = track_take(folder / "take.toml")
    right, T = truth()
    x = right.joint_centres @ T[:3, :3].T + T[:3, 3] + [0.0, 0.0, 1.0]  # the floor is at zero
    hips = [right.body.tree.segment(f"thigh_{side}") for side in "lr"]
    found = motion.joint_centres
    apart = (found - found[:, hips].mean(axis=1, keepdims=True)) - (x - x[:, hips].mean(axis=1, keepdims=True))
    assert np.linalg.norm(apart, axis=2).mean() < 0.05
    assert np.linalg.norm(found[:, 0] - x[:, 0], axis=1).max() < 0.25  # three and a half metres away
    assert motion.lost.mean() < 0.02 and motion.provenance["smoothing"]["contacts"] > 30
    inside = np.abs(found - x) < 1.96 * motion.joint_std
    assert 0.8 < inside.mean() <= 1.0
    assert motion.joint_std[:, 0, 1].mean() > 2 * motion.joint_std[:, 0, 0].mean()  # y is away from the camera
    sigma = motion.provenance["smoothing"]["pixel_sigma"]["phone"]
    assert set(sigma.values()) == {8.0}  # as stated, though nothing is left over but a jitter of 3 px
    assert {"phone", "lifted phone"} <= set(motion.residuals)
    assert any("field of view of 64°, the default" in note for note in seen.notes)


def test_the_world_stands_on_the_floor(folder):
    """Feet that rest tell the floor, and the telephone's tilt as far as they and the upright body do."""
    right, T = truth()
    write_phone(folder / "tilted.npz", tilted(T))
    (folder / "tilted.toml").write_text(HEAD + "height = 1.75\n" + CAMERA + DETECTED.replace("phone.npz", "tilted.npz"))
    motion, seen = track_take(folder / "tilted.toml")
    told = motion.provenance["floor"]
    x = right.joint_centres @ T[:3, :3].T + T[:3, 3]
    up = se3.aligned(motion.joint_centres.reshape(-1, 3), x.reshape(-1, 3))[:3, :3] @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up[2])) < min(4.0, 2.5 * told["tilt_std_deg"])
    points = soles(motion.body)
    lowest = motion.positions(points)[..., 2].min(axis=1)
    assert abs(np.median(lowest)) < 0.01 and np.ptp(lowest) < 0.03
    feet = motion.positions(points)
    assert np.linalg.norm(feet - np.median(feet, axis=0), axis=2).max() < 0.015  # the person stays
    (camera,), overlay = seen.rig, motion.residuals["phone"]
    assert camera.centre_world[2] > 0.5
    names = list(overlay.names)
    fitted = overlay.measured - overlay.values
    points = motion.body.keypoints("MEDIAPIPE_33").select(tuple(names))
    assert np.allclose(camera.project(motion.positions(points)[10]), fitted[10], atol=0.5)  # cameras moved along


def test_a_take_may_start_from_its_own_motion(folder):
    """The motion's world stands on the floor, the take's camera at the origin."""
    (folder / "first.toml").write_text(HEAD + "frames = [0, 20]\nheight = 1.75\n" + CAMERA + DETECTED)
    motion, _ = track_take(folder / "first.toml")
    write_motion(motion, folder / "first-motion.npz")
    (folder / "again.toml").write_text(
        HEAD + 'frames = [0, 20]\nstart = "first-motion.npz"\n' + CAMERA + DETECTED
    )
    again, _ = track_take(folder / "again.toml")
    assert np.linalg.norm(again.joint_centres - motion.joint_centres, axis=2).mean() < 0.03


def test_lengths_are_unsure_where_no_height_is_stated(folder):
    (folder / "short.toml").write_text(HEAD + "frames = [0, 20]\n" + CAMERA + DETECTED)
    motion, seen = track_take(folder / "short.toml")
    assert 0.05 < motion.provenance["length_std_m"]["thigh_r-shank_r"] / 0.43 < 0.2
    assert any("no height is stated" in note for note in seen.notes)


@pytest.mark.parametrize("size", [0.7, 1.0, 1.1])
def test_the_network_measures_the_size_where_no_height_is_stated(folder, size):
    """A child of 1.22 m, and taller people, as far as people's sizes (20 %) leave it to a network (8 %)."""
    write_phone(folder / "sized.npz", truth()[1], size, metres=0.91, depth_error=0.01)
    (folder / "sized.toml").write_text(HEAD + "frames = [0, 30]\n" + CAMERA + DETECTED.replace("phone.", "sized."))
    motion, _ = track_take(folder / "sized.toml")
    shape = motion.provenance["shape"]
    lengths = np.array([value for name, value in shape.items() if name.startswith("length")])
    assert np.mean(lengths[:, 0]) == pytest.approx(np.log(size) * 0.2**2 / (0.2**2 + 0.08**2), abs=0.04)
    assert np.all((lengths[:, 1] > 0.06) & (lengths[:, 1] < 0.11))


def test_who_is_in_view_is_told(folder):
    view = people_in_view(read_take(folder / "take.toml"))
    assert view is not None and len(view.people) < 2


def test_a_camera_without_calibration_is_level_and_of_a_usual_lens(folder):
    for up, axis in (("z", 2), ("y", 1)):
        text = HEAD + f'up = "{up}"\n' + CAMERA + "field_of_view = 90.0\n" + DETECTED
        (folder / "wide.toml").write_text(text)
        (camera,) = load_observations(read_take(folder / "wide.toml")).rig
        assert camera.matrix[0, 0] == pytest.approx(640.0) and camera.size == SIZE
        assert camera.T_camera_world[1, axis] == -1.0 and np.linalg.det(camera.T_camera_world[:3, :3]) > 0


BAD = {
    "too wide": (CAMERA + "field_of_view = 200.0\n" + DETECTED, TakeError, "field_of_view = 200"),
    "other keypoints": (CAMERA + DETECTED.replace('"detect"', '"openpose"'), TakeError, "do not give a person"),
    "not lifted": (CAMERA + DETECTED, TrackingError, "kinefit detect --force"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_told(case, folder):
    text, kind, problem = BAD[case]
    if case == "not lifted":


        write_detections(replace(read_detections(folder / "phone.npz"), lifted=None), folder / "old.npz")
        text = text.replace("phone.npz", "old.npz")
    (folder / "bad.toml").write_text(HEAD + text)
    with pytest.raises(kind) as told:
        track_take(folder / "bad.toml")
    assert problem in str(told.value)


def test_a_click_leaves_the_landmarks_in_space(folder, tmp_path):
    """A joint that is placed by hand is no other sensor: the only camera still tells depth."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    plain = load_observations(read_take(tmp_path / "take.toml"))
    wrist = plain.keypoints[0].points[5, 0, MEDIAPIPE_33.index("right_wrist")]
    add_click(tmp_path / "take.toml", 5, "phone", "r_wrist", wrist)
    take = read_take(tmp_path / "take.toml")
    recording, _ = recording_of(take, load_observations(take), load_body(take.body))
    assert recording.keypoints[0].lifted is not None and recording.alone is not None
    assert [type(f).__name__ for f in recording.steps(5)] == ["ClickFrame", "LiftedFrame", "KeypointFrame"]
    assert [type(f).__name__ for f in recording.steps(6)] == ["LiftedFrame", "KeypointFrame"]
