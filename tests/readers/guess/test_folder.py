"""A take file guessed from a folder: made-up recordings under all sorts of names, and real ones."""

import json
import re
from dataclasses import replace
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from kinefit.errors import CalibrationError, TakeError
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.guess.names import trials
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.take.cameras import read_rig
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig

SIZE = (272, 480)


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 0, 30)


@pytest.fixture(scope="module")
def rig(motion):
    return studio_rig(motion, size=SIZE)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "recording").mkdir()
    return tmp_path / "recording"


def renamed(rig, names):
    return Rig(tuple(replace(camera, name=name) for camera, name in zip(rig, names, strict=True)))


def write_video(path, size=SIZE, frames=30, bar=0, rate=30):
    """A grey video, with black bars of `bar` px above and below."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = np.full((size[1], size[0], 3), 128, np.uint8)
    picture[:bar], picture[size[1] - bar :] = 0, 0
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(rate))
        (stream.width, stream.height), stream.pix_fmt = size, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())


def write_videos(folder, names, **how):
    for name in names:
        write_video(folder / name, **how)


def write_mediapipe(folder, motion, rig, names, images=(), normalised=False):
    seen = simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=1.0, outliers=0.0, missing=0.0)
    for number, (record, name) in enumerate(zip(seen, names)):
        points = images[number].from_calibration(record.points[:, 0]) if images else record.points[:, 0]
        points = points / SIZE if normalised else points
        np.save(folder / name, np.nan_to_num(np.concatenate([points, record.confidence[:, 0, :, None]], -1)))


def write_openpose(folder, record):
    folder.mkdir(parents=True)
    for frame, (people, confidence) in enumerate(zip(record.points, record.confidence)):
        numbers = np.nan_to_num(np.concatenate([people[0], confidence[0][:, None]], axis=1)).ravel().tolist()
        text = json.dumps({"people": [{"pose_keypoints_2d": numbers}]})
        (folder / f"clip_{frame:012d}_keypoints.json").write_text(text)


def taken(folder):
    """The take of a folder, read and loaded, with its notes; the folder is unchanged by guessing."""
    before = sorted(folder.rglob("*"))
    guess = guess_take(folder)
    assert sorted(folder.rglob("*")) == before
    (folder / "take.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(folder / "take.toml")
    return take, load_observations(take), guess


def notes(guess, about=""):
    return " | ".join(f"{note.sure} {note.about}: {note.text}" for note in guess.notes if about in note.about)


@pytest.mark.parametrize(
    ("files", "sure"),
    [
        ({"cam04": "cam04.mp4", "cam02": "CAM02.avi", "cam01": "cam01.mkv", "cam03": "cam03.mov"}, "sure"),
        ({f"cam0{k}": f"walk_cam0{k}.mp4" for k in (1, 2, 3, 4)}, "sure"),
        ({"far": "far_view.mp4", "left": "Left.mp4", "right": "the right.mp4", "top": "top.mp4"}, "sure"),
        ({str(n): f"Miqus_3_{n}.mp4" for n in (21320, 21321, 21322, 2132)}, "sure"),
        ({f"cam0{k}": f"cam0{k}/GX0{9 - k}0055.mp4" for k in (1, 2, 3, 4)}, "sure"),
        ({n: f"2019-08-02-vid01-cam{n}.mov" for n in "ABCD"}, "sure"),
        ({n: f"{n}.mp4" for n in "1234"}, "sure"),
        ({n: f"2024-1-2-cam{n}.mp4" for n in "1234"}, "sure"),
        ({n: f"snowboard_{n}.mp4" for n in ("c1", "c2", "c3", "c4")}, "sure"),
        ({f"cam_{k}": f"port_{k}.mp4" for k in (0, 1, 2, 3)}, "likely"),
        ({f"cam{k:02}": f"Camera {k}.mp4" for k in (1, 2, 3, 10)}, "likely"),
        ({f"cam{k}": f"view{k:03} 2024-11-0{9 - k}.mp4" for k in (1, 2, 3, 4)}, "likely"),
        ({f"cam{k}": f"GX01001{k - 1}.mp4" for k in (1, 2, 3, 4)}, "guess"),
        (dict(zip(("east", "north", "south", "west"), ("a.mp4", "b2.mp4", "b10.mp4", "d.mp4"))), "guess"),
    ],
)
def test_videos_find_their_cameras(folder, rig, files, sure):
    write_calibration(renamed(rig, list(files)), folder / "calibration.toml")
    write_videos(folder, files.values(), frames=2)
    take, _, guess = taken(folder)
    assert {entry.name: entry.video.relative_to(folder).as_posix() for entry in take.cameras} == files
    assert notes(guess, "camera ").count(f"{sure} camera") == 4


def test_a_camera_of_another_size_is_told_by_it(folder, rig):
    sizes = [(320, 240), (400, 300), (272, 480), (640, 480)]
    own = Rig(tuple(camera.scaled(size) for camera, size in zip(rig, sizes)))
    write_calibration(renamed(own, ["a1x", "b1x", "c1x", "d1x"]), folder / "calibration.toml")
    for name, size in zip(("p.mp4", "q.mp4", "r.mp4", "s.mp4"), reversed(sizes)):
        write_video(folder / name, size=size, frames=2)
    take, _, guess = taken(folder)
    assert [entry.video.name for entry in take.cameras] == ["s.mp4", "r.mp4", "q.mp4", "p.mp4"]
    assert notes(guess, "camera").count("by its image size") == 4


def test_two_recordings_of_one_session_are_kept_apart(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    for trial, frames in (("walk", 3), ("jump", 9), ("static", 30)):
        write_videos(folder, [f"{trial}_{name}.mp4" for name in rig.names], frames=frames)
    write_videos(folder, [f"intrinsics/{name}.mp4" for name in rig.names], frames=40)
    take, _, guess = taken(folder)
    assert {entry.video.name for entry in take.cameras} == {f"jump_{name}.mp4" for name in rig.names}
    told = notes(guess, "video")
    assert "jump_*: used" in told and "walk_*: another recording" in told and "static_*: a static trial" in told
    assert "# subject = " in guess.text


def test_files_of_no_camera_are_left_out(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, ["cam01.mp4", "cam03.mp4", "overview.mp4"], frames=2)
    take, _, guess = taken(folder)
    assert [entry.name for entry in take.cameras] == ["cam01", "cam03"]
    assert "overview.mp4 fits no camera" in notes(guess, "video")
    assert "cam02, cam04 of the calibration: no file here fits" in notes(guess, "cameras")


def test_videos_without_keypoints_go_to_the_detector(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names], frames=5)
    take, seen, guess = taken(folder)
    assert take.keypoints == () and len(seen.videos) == 4 and take.rate == 30.0
    assert "kinefit track runs the built-in detector" in notes(guess, "keypoints")


def test_videos_of_different_length_and_of_different_rate(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    for number, name in enumerate(rig.names):
        write_video(folder / f"{name}.mp4", frames=5 + number)
    take, _, guess = taken(folder)
    assert take.frames == (0, 5) and "guess frames" in notes(guess)
    write_video(folder / "cam02.mp4", rate=25)
    said = notes(guess_take(folder))
    assert "likely rate: rate = 30.0: the highest of the videos (cam01 30, cam02 25, cam03 30, cam04 30 Hz)" in said


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0), ("inch", 1 / 0.0254)])
def test_the_unit_follows_from_the_person(folder, motion, rig, unit, factor):
    def far(camera):
        T = camera.T_camera_world.copy()
        T[:3, 3] *= factor
        return camera.with_pose(T)

    write_calibration(Rig(tuple(map(far, rig))), folder / "calibration.toml")
    text = (folder / "calibration.toml").read_text()
    (folder / "calibration.toml").write_text(text.replace('unit = "m"\n', ""))
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    take = read_guess(folder)
    assert take.calibration.unit == unit


def read_guess(folder):
    """The take where its rate is not told by any file."""
    guess = guess_take(folder)
    assert "open rate" in notes(guess)
    (folder / "take.toml").write_text(guess.text, encoding="utf-8")
    return read_take(folder / "take.toml")


@pytest.mark.parametrize("up", ["x", "y", "-z"])
@pytest.mark.parametrize("keypoints", [True, False])
def test_up_follows_from_person_and_cameras(folder, motion, up, keypoints):
    own = motion.turned(up)
    rig = studio_rig(own, size=SIZE)
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names], frames=30)
    if keypoints:
        write_mediapipe(folder, own, rig, [f"{name}.npy" for name in rig.names])
    take, _, guess = taken(folder)
    assert take.up == up
    assert notes(guess, "up").startswith("sure" if keypoints else "likely")


def test_a_person_on_the_ceiling_is_no_certain_up(folder, motion, rig):
    """Cameras upside down, as in a mirrored world: both opinions are told."""
    def upside_down(camera):
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        K = camera.matrix.copy()
        K[:2, 2] = np.subtract(camera.size, 1) - K[:2, 2]
        return Camera(camera.name, camera.size, K, (), T_camera_world=turn @ camera.T_camera_world)

    own = Rig(tuple(map(upside_down, rig)))
    write_calibration(own, folder / "calibration.toml")
    write_mediapipe(folder, motion, own, [f"{name}.npy" for name in own.names])
    told = notes(guess_take(folder), "up")
    assert told.startswith("guess")
    assert 'up = "z": the person stands upright; but the cameras stand upright would give -z' in told


@pytest.mark.parametrize("keypoint_set", ["BODY_25", "BODY_25B", "COCO_17", "COCO_18", "HALPE_26"])
def test_the_set_follows_from_the_points(folder, motion, rig, keypoint_set):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    for record in simulate_keypoints(motion, rig, keypoint_set, noise_px=1.5):
        write_openpose(folder / "pose" / f"{record.camera}_json", record)
    take, seen, _ = taken(folder)
    assert [(k.camera, k.set, k.format) for k in take.keypoints] == [(n, keypoint_set, "openpose") for n in rig.names]
    assert seen.keypoints[0].names == KEYPOINT_SETS[keypoint_set]


def write_alphapose(path, data):
    people = [{"image_id": f"{i}.jpg", "category_id": 1, "keypoints": row.ravel().tolist(), "score": 2.5}
              for i, row in enumerate(data)]  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(people))


def write_mmpose(path, data):
    frames = [{"frame_id": i, "instances": [{"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist()}]}
              for i, row in enumerate(data)]  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(frames))


def write_deeplabcut(path, data):
    names = [name for name in KEYPOINT_SETS["COCO_17"] for _ in range(3)]
    heads = [["scorer", *51 * ["net"]], ["bodyparts", *names], ["coords", *17 * ["x", "y", "likelihood"]]]
    rows = [[k, *row.ravel()] for k, row in enumerate(data)]
    path.with_suffix(".csv").write_text("\n".join(",".join(map(str, row)) for row in heads + rows))


def write_sleap(path, data):
    columns = ",".join(f"{name}.{axis}" for name in KEYPOINT_SETS["COCO_17"] for axis in ("x", "y", "score"))
    rows = [f",{k},0.9," + ",".join(map(str, row.ravel())) for k, row in enumerate(data)]
    path.with_suffix(".csv").write_text("\n".join([f"track,frame_idx,instance.score,{columns}", *rows]))


WRITERS = {"alphapose": write_alphapose, "mmpose": write_mmpose, "deeplabcut": write_deeplabcut, "sleap": write_sleap}


@pytest.mark.parametrize("format", WRITERS)
def test_files_of_other_programs(folder, motion, rig, format):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    records = simulate_keypoints(motion, rig, "COCO_17", noise_px=1.5)
    for record in records:
        data = np.nan_to_num(np.concatenate([record.points[:, 0], record.confidence[:, 0, :, None]], -1))
        WRITERS[format](folder / record.camera, data)
    take, seen, guess = taken(folder)
    assert [(k.camera, k.format) for k in take.keypoints] == [(name, format) for name in rig.names]
    assert f"{format}, COCO_17, 4 cameras: used" in notes(guess)
    for own, record in zip(seen.keypoints, records):
        np.testing.assert_allclose(own.points, record.points[: len(own)], atol=1e-9)


def test_one_video_and_its_keypoints_without_a_calibration(folder, motion, rig):
    write_video(folder / "cam1.mp4")
    record = simulate_keypoints(motion, rig, "COCO_17")[0]
    write_alphapose(folder / "results", np.nan_to_num(np.dstack([record.points[:, 0], record.confidence[:, 0]])))
    guess = guess_take(folder)
    assert "open keypoints: results.json: not used without a calibration of its camera" in notes(guess)
    assert "[[keypoints]]" not in guess.text and 'video = "cam1.mp4"' in guess.text
    write_video(folder / "cam2.mp4")
    with pytest.raises(CalibrationError, match="no calibration of the cameras"):
        guess_take(folder)


def test_arrays_of_freemocap(folder, motion, rig):
    rig = renamed(rig, [f"cam_{k}" for k in range(len(rig))])
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"synchronized_videos/Camera_{k:03d}_synchronized.mp4" for k in range(len(rig))])
    records = simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=1.0)
    data = np.full((len(rig), 30, 553, 3), np.nan)
    data[:, :, :33, :2] = [record.points[:, 0] for record in records]
    (folder / "output_data").mkdir()
    np.save(folder / "output_data" / "mediapipe2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy", data)
    np.save(folder / "output_data" / "mediapipe3dData_numFrames_numTrackedPoints_spatialXYZ.npy", data[0])
    take, seen, guess = taken(folder)
    assert [(k.camera, k.format) for k in take.keypoints] == [(name, "freemocap") for name in rig.names]
    assert "mediapipe3dData_numFrames_numTrackedPoints_spatialXYZ.npy: an array of shape (30, 553, 3)" in notes(guess)
    for own, record in zip(seen.keypoints, records):
        np.testing.assert_allclose(own.points[:, :, :33], record.points)


def test_a_project_of_pose2sim(folder, motion, rig):
    """Calibration, videos, and the folders of its steps, of which that with all people at one clock is used."""
    (folder / "calibration").mkdir()
    write_calibration(rig, folder / "calibration" / "Calib.toml")
    write_videos(folder / "videos", [f"{name}.mp4" for name in rig.names])
    (folder / "Config.toml").write_text("[project]\nframe_rate = 30\n")
    for step in ("pose", "pose-sync", "pose-associated"):
        for record in simulate_keypoints(motion, rig, "HALPE_26", noise_px=1.5):
            write_openpose(folder / step / f"{record.camera}_json", record)
    empty = next((folder / "pose-associated" / f"{rig.names[0]}_json").iterdir())
    empty.write_text(json.dumps({"people": [{}]}))
    assert {k.file.parts[-2] for k in taken(folder)[0].keypoints} == {"pose-sync"}
    for step in ("pose-sync", "pose"):
        for file in (folder / step).rglob("*.json"):
            file.unlink()
        left = {k.file.parts[-2] for k in taken(folder)[0].keypoints}
        assert left == {"pose" if step == "pose-sync" else "pose-associated"}
    assert {k.set for k in taken(folder)[0].keypoints} == {"HALPE_26"}


@pytest.mark.parametrize("body_set", ["BODY_25", "BODY_25B"])
@pytest.mark.parametrize("seen_hands", [True, False])
def test_where_hands_are_seen_the_body_has_fingers(folder, motion, rig, body_set, seen_hands):
    """OpenPose with hands of BODY_25; beside those of BODY_25B, which have no set, the body's points are taken."""
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    for record in simulate_keypoints(motion, rig, body_set, noise_px=1.5):
        write_openpose(folder / "pose" / f"{record.camera}_json", record)
        for path in (folder / "pose" / f"{record.camera}_json").iterdir():
            frame = json.loads(path.read_text())
            for person in frame["people"]:
                person["hand_left_keypoints_2d"] = [40.0, 50.0, 0.7 * seen_hands] * 21
                person["hand_right_keypoints_2d"] = [0.0] * 63
            path.write_text(json.dumps(frame))
    take, _, _ = taken(folder)
    assert {k.set for k in take.keypoints} == {"BODY_25_HANDS" if body_set == "BODY_25" else "BODY_25B"}
    assert take.body == ("humanoid_hands" if body_set == "BODY_25" and seen_hands else "humanoid")


def test_of_two_detectors_one_is_left_as_comments(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_mediapipe(folder, motion, rig, [f"mediapipe_{name}.npy" for name in rig.names])
    for record in simulate_keypoints(motion, rig, "COCO_17"):
        write_openpose(folder / "pose" / record.camera, record)
    take = read_guess(folder)
    assert {k.format for k in take.keypoints} == {"openpose"}
    assert (folder / "take.toml").read_text().count('# format = "mediapipe"') == 4
    text = (folder / "take.toml").read_text()
    (folder / "take.toml").write_text(re.sub(r"^# (?=\[\[keyp|camera =|file =|format =)", "", text, flags=re.M))
    assert len(read_take(folder / "take.toml").keypoints) == 8


@pytest.mark.parametrize(
    ("size", "bar", "image"),
    [((136, 240), 0, "scaled"), ((272, 504), 12, "letterboxed"), ((272, 540), 0, "scaled")],
)
@pytest.mark.parametrize("frame", ["video", "calibration"])
def test_pictures_of_another_size(folder, motion, rig, size, bar, image, frame):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names], size=size, bar=bar)
    made = ImageFrame.scaled(SIZE, size) if image == "scaled" else ImageFrame.letterboxed(SIZE, size)
    write_mediapipe(folder, motion, rig, [f"{n}.npy" for n in rig.names], images=[made] * 4 if frame == "video" else ())
    take, seen, guess = taken(folder)
    assert {entry.image for entry in take.cameras} == {image}
    assert {k.frame for k in take.keypoints} == {frame}
    truth = simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=1.0, outliers=0.0, missing=0.0)
    for got, true in zip(seen.keypoints, truth):
        shown = np.isfinite(got.points).all(-1) & np.isfinite(true.points).all(-1)
        assert np.abs(got.points - true.points)[shown].max() < 1e-3
    assert "guess keypoints, mediapipe: frame" not in notes(guess)


@pytest.mark.parametrize("degrees", [90, 270])
def test_turned_pictures_show_people_upright(folder, motion, rig, degrees):
    """Calibrated lying, filmed upright: the turn that puts the vertical up is taken."""
    def lying(camera):
        back = ImageFrame.rotated(camera.size, -degrees % 360).T_image_calibration
        turn = np.eye(4)
        turn[:2, :2] = back[:2, :2]
        K = np.diag([camera.matrix[1, 1], camera.matrix[0, 0], 1.0])
        K[:2, 2] = back[:2, :2] @ camera.matrix[:2, 2] + back[:2, 2]
        return Camera(camera.name, camera.size[::-1], K, (), T_camera_world=turn @ camera.T_camera_world)

    own = Rig(tuple(map(lying, rig)))
    write_calibration(own, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    write_mediapipe(
        folder, motion, own, [f"{n}.npy" for n in rig.names], images=[ImageFrame.rotated(c.size, degrees) for c in own]
    )
    take, _, _ = taken(folder)
    assert take.up == "z"
    assert {entry.rotation for entry in take.cameras} == {degrees}
    assert {k.frame for k in take.keypoints} == {"video"}


def test_the_calibration_may_lie_above_and_the_refined_is_preferred(folder, rig):
    write_calibration(rig, folder / "Calib.toml")
    (folder / "trial").mkdir()
    write_videos(folder / "trial", [f"{name}.mp4" for name in rig.names], frames=2)
    assert taken(folder / "trial")[0].calibration.file == folder / "trial" / ".." / "Calib.toml"
    write_calibration(rig, folder / "trial" / "calib_refined.toml")
    write_calibration(rig, folder / "trial" / "calib.toml")
    guess = guess_take(folder / "trial")
    assert "calib_refined.toml: 4 cameras" in notes(guess) and "its name says that it was refined" in notes(guess)
    assert '# file = "calib.toml"' in guess.text
    write_calibration(renamed(rig, ["p", "q", "r", "s"]), folder / "trial" / "other_refined.toml")
    assert "calib_refined.toml: 4 cameras" in notes(guess_take(folder / "trial"))  # the other fits no video


def test_calibrations_of_one_file_a_camera_are_found_as_a_folder(folder, rig):
    (folder / "calib").mkdir()
    for camera in rig:
        K, D, T = camera.matrix.tolist(), camera.distortion.tolist(), camera.T_camera_world[:3].tolist()
        text = json.dumps({"name": camera.name, "K": K, "dist": D, "extrinsic": T, "image_size": list(camera.size)})
        (folder / "calib" / f"{camera.name}.json").write_text(text)
    write_videos(folder, [f"{name}.mp4" for name in rig.names], frames=2)
    take, seen, _ = taken(folder)
    assert take.calibration.file == folder / "calib" and len(seen.rig) == 4


def without_sizes(rig):
    cameras = [
        {"name": c.name, "K": c.matrix.tolist(), "R": c.T_camera_world[:3, :3].tolist(),
         "t": c.T_camera_world[:3, 3].tolist()}
        for c in rig
    ]  # fmt: skip
    return json.dumps({"cameras": cameras})


@pytest.mark.parametrize("turned", [False, True])
def test_sizes_that_a_calibration_lacks_are_those_of_the_videos(folder, motion, rig, turned):
    (folder / "calibration.json").write_text(without_sizes(rig))
    write_videos(folder, [f"{name}.mp4" for name in rig.names], size=SIZE[::-1] if turned else SIZE)
    write_video(folder / "calib" / f"board_{rig.names[0]}.mp4", size=(64, 48))
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    _, seen, guess = taken(folder)
    assert {camera.size for camera in seen.rig} == {SIZE[::-1] if turned else SIZE}
    assert f"likely calibration: no image size of {', '.join(rig.names)}" in notes(guess)
    text = (folder / "take.toml").read_text()
    turn = re.sub(r"^(video = .*)$", r"\1\nrotation = 90", text, flags=re.M)
    (folder / "take.toml").write_text(turn)
    assert {c.size for c in read_rig(read_take(folder / "take.toml"))} == {SIZE if turned else SIZE[::-1]}
    two = "".join(re.split(r"(?=\[\[)", text)[:3])  # of the four cameras two
    (folder / "take.toml").write_text(two)
    assert read_rig(read_take(folder / "take.toml")).names == rig.names[:2]
    for change in ('image = "scaled"', "size = [10, 10]"):
        (folder / "take.toml").write_text(re.sub(r"^video = .*$", change, text, flags=re.M))
        if "size" in change:
            assert {c.size for c in read_rig(read_take(folder / "take.toml"))} == {(10, 10)}
        else:
            with pytest.raises(CalibrationError, match=f"camera {rig.names[0]}: the size of its image is missing"):
                read_rig(read_take(folder / "take.toml"))


def test_a_calibration_without_sizes_or_videos_is_told(folder, motion, rig):
    (folder / "calibration.json").write_text(without_sizes(rig))
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    missing = rf"camera {rig.names[0]}: .*size of its image is missing.*\[\[camera\]\]"
    with pytest.raises(CalibrationError, match=missing):
        guess_take(folder)


def test_easymocap_and_calibrations_in_txt_are_found(folder, motion, rig):
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    intri = extri = ""
    for c in rig:
        intri += f"K_{c.name}: {c.matrix.tolist()}\ndist_{c.name}: {c.distortion.tolist()}\n"
        extri += f"Rot_{c.name}: {c.T_camera_world[:3, :3].tolist()}\nT_{c.name}: {c.T_camera_world[:3, 3].tolist()}\n"
    (folder / "intri.yml").write_text("%YAML:1.0\n---\n" + intri)
    (folder / "extri.yml").write_text("%YAML:1.0\n---\n" + extri)
    _, seen, _ = taken(folder)
    for one, other in zip(seen.rig, rig):
        np.testing.assert_allclose(one.packed, other.packed, atol=1e-9)
    (folder / "intri.yml").unlink()
    (folder / "calib.txt").write_text("<calibration><cameras><camera")
    with pytest.raises(CalibrationError, match=r"calib\.txt.*no calibration can be used: broken XML"):
        guess_take(folder)


def test_normalised_coordinates_and_odd_arrays_are_told(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names])
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names], normalised=True)
    np.save(folder / "smpl.npy", np.zeros((30, 24, 3)))
    take, _, guess = taken(folder)
    assert take.keypoints == ()
    assert "coordinates run from 0 to 1" in notes(guess) and "smpl.npy: an array of shape (30, 24, 3)" in notes(guess)


def test_keypoints_of_which_none_can_be_used(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names], normalised=True)
    with pytest.raises(TakeError, match="cannot be used|can be used with the cameras.*run from 0 to 1"):
        guess_take(folder)
    for record in simulate_keypoints(motion, rig, "COCO_17"):
        write_openpose(folder / record.camera, record)
    for file in folder.rglob("*.json"):  # a set that nobody knows
        text = json.loads(file.read_text())
        text["people"][0]["pose_keypoints_2d"] += [0.0] * 6
        file.write_text(json.dumps(text))
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    take = read_guess(folder)
    assert {k.format for k in take.keypoints} == {"mediapipe"}
    assert "19 points; there are sets of 17, 18, 25, 26, 33, 67, 75, 133" in notes(guess_take(folder))


def test_keypoints_of_another_recording_are_left_out(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names], frames=60)
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    take, _, guess = taken(folder)
    assert take.keypoints == () and "30 frames, the videos have 60: another recording" in notes(guess)


def test_keypoints_go_with_the_recording_that_shares_their_words(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    for trial, bitrate in (("walk", 0), ("run", 4)):
        write_videos(folder, [f"{trial}/videos/{name}.mp4" for name in rig.names], bar=bitrate)
        (folder / trial / "pose").mkdir()
        write_mediapipe(folder / trial / "pose", motion, rig, [f"{name}.npy" for name in rig.names])
    take, _, _ = taken(folder)
    trial = take.cameras[0].video.parts[-3]
    assert {entry.video.parts[-3] for entry in take.cameras} == {trial}
    assert {entry.file.parts[-3] for entry in take.keypoints} == {trial}


def test_a_camera_with_keypoints_and_no_video_is_kept(folder, motion, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, ["cam01.mp4", "cam02.mp4"])
    write_mediapipe(folder, motion, rig, [f"{name}.npy" for name in rig.names])
    take, seen, _ = taken(folder)
    assert [entry.video is not None for entry in take.cameras] == [True, True, False, False]
    assert len(seen.keypoints) == 4


def test_videos_that_a_detector_drew_on_are_not_taken(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"videos/{name}.mp4" for name in rig.names], frames=2)
    write_videos(folder, [f"pose/{name}_pose.mp4" for name in rig.names], frames=9)
    write_videos(folder, [f"videos/more/{name}.mp4" for name in rig.names], frames=9)
    take, _, guess = taken(folder)
    assert {entry.video.parent for entry in take.cameras} == {folder / "videos"}
    assert "pose/*_pose: another recording, or a detector's overlay" in notes(guess, "video")


def test_what_kinefit_left_is_no_recording(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, [f"{name}.mp4" for name in rig.names], frames=2)
    write_videos(folder, [f"take-kinefit/overlays/{name}.mp4" for name in rig.names], frames=9)
    take, _, guess = taken(folder)
    assert {entry.video.parent for entry in take.cameras} == {folder}
    assert "kinefit/" not in notes(guess)


def test_an_empty_folder_and_none(folder):
    (folder / "readme.txt").write_text("nothing")
    with pytest.raises(TakeError, match="no videos, keypoints, markers, depth or recordings among 1 files"):
        guess_take(folder)
    with pytest.raises(TakeError, match="no such folder"):
        guess_take(folder / "none")


def test_names_that_fit_nothing(folder, rig):
    write_calibration(rig, folder / "calibration.toml")
    write_videos(folder, ["kitchen.mp4", "garden.mp4"], frames=2)
    with pytest.raises(TakeError, match="after its camera: cam01, cam02, cam03, cam04"):
        guess_take(folder)


def test_markers_alone(folder):
    text = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n100\t100\t2\t2\tmm\n"
    text += "Frame#\tTime\tA\t\t\tB\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
    text += "1\t0.00\t1\t2\t3\t4\t1500\t6\n2\t0.01\t1\t2\t3\t4\t1500\t6\n"
    (folder / "walk.trc").write_text(text)
    (folder / "static.trc").write_text(text)
    (folder / "bad.c3d").write_bytes(b"\x02\x50")
    take, _, guess = taken(folder)
    assert [entry.file.name for entry in take.markers] == ["walk.trc"] and (take.up, take.rate) == ("y", 100.0)
    assert "bad.c3d not used" in notes(guess) and take.markers[0].static.name == "static.trc"
    assert "needs cameras" not in notes(guess) and "static.trc: the static trial" in notes(guess)
    (folder / "walk.trc").unlink()
    (folder / "static.trc").unlink()
    with pytest.raises(TakeError, match="no marker file can be read"):
        guess_take(folder)


def test_files_of_a_trial_stand_in_the_order_of_the_calibration(tmp_path):
    paths = [tmp_path / name for name in ("b_c2.mp4", "b_c10.mp4", "b_c1.mp4")]
    for path in paths:
        path.touch()
    (trial,), left = trials(paths, tmp_path, ["c10", "c1", "c2"])
    assert list(trial.files) == ["c10", "c1", "c2"] and trial.place == "b_*" and not left


def test_the_balancing_trial(data_dir, tmp_path):
    folder = data_dir("video_balancing_4cam")
    guess = guess_take(folder, beside=tmp_path)
    (tmp_path / "take.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(tmp_path / "take.toml")
    assert take.calibration.file.name == "Calib_refined_static.toml" and take.up == "z" and take.rate == 60.0
    assert {c.name: c.image for c in take.cameras} == {
        "cam01": "letterboxed", "cam02": "letterboxed", "cam03": "as calibrated", "cam04": "as calibrated",
    }  # fmt: skip
    videos = {(folder / "videos" / f"cam0{k}.mp4").resolve() for k in (1, 2, 3, 4)}
    assert {c.video.resolve() for c in take.cameras} == videos
    assert [(k.camera, k.set) for k in take.keypoints] == [(f"cam0{k}", "BODY_25B") for k in (1, 2, 3, 4)]
    assert "static_trial/videos/*: a static trial" in notes(guess)
    assert {k.frame for k in take.keypoints if k.camera in ("cam01", "cam02")} == {"calibration"}  # SOURCE.txt, trap 1
    assert "as in the static trial" in notes(guess, "keypoints, openpose")
    seen = load_observations(take)
    assert seen.frames == (0, 100) and len(seen.keypoints) == 4


@pytest.mark.parametrize("calibration", ["Calib_refined_static.toml", "calibration"])
def test_the_frame_of_keypoints_follows_the_evidence_that_is_printed(data_dir, tmp_path, calibration):
    """A calibration that is off by 12 px, and no static trial: SOURCE.txt, trap 1, tells the frames."""
    data = data_dir("video_balancing_4cam")
    for name in ("videos", "openpose_json", calibration, *(f"mediapipe_landmarks_cam0{k}.npy" for k in (1, 2, 3, 4))):
        (tmp_path / name).symlink_to(data / name)
    guess = guess_take(tmp_path)
    (tmp_path / "take.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(tmp_path / "take.toml")
    assert {k.frame for k in take.keypoints if k.camera in ("cam01", "cam02")} == {"calibration"}
    for detector, frame in (("openpose", "calibration"), ("mediapipe", "video")):
        told = notes(guess, f"keypoints, {detector}")
        taken_px, other_px = map(float, re.findall(r"([\d.]+) px", told))
        assert f'guess keypoints, {detector}: frame = "{frame}"' in told and taken_px < other_px


def test_its_static_trial_tells_the_frame_of_the_keypoints(data_dir, tmp_path):
    guess = guess_take(data_dir("video_balancing_4cam") / "static_trial", beside=tmp_path)
    (tmp_path / "take.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(tmp_path / "take.toml")
    assert {k.frame for k in take.keypoints if k.camera in ("cam03", "cam04")} == {"calibration"}  # SOURCE.txt, trap 1
    assert take.frames == (0, 11) and len(load_observations(take).keypoints) == 4


def test_recordings_of_caliscope(data_dir, tmp_path):
    guess = guess_take(data_dir("mv4_upperbody_caliscope"), beside=tmp_path)
    (tmp_path / "a.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(tmp_path / "a.toml")
    assert [c.video.name for c in take.cameras] == [f"port_{k}.mp4" for k in range(4)]
    assert (take.rate, take.up, load_observations(take).frames) == (6.0, "z", (0, 111))
    guess = guess_take(data_dir("mv4_landmarks_caliscope"), beside=tmp_path)
    (tmp_path / "b.toml").write_text(guess.text, encoding="utf-8")
    take = read_take(tmp_path / "b.toml")
    assert {k.format for k in take.keypoints} == {"caliscope"} and take.up == "x" and take.body == "humanoid_hands"
    assert all(c.video is None for c in take.cameras)  # its videos are of the calibration
    seen = load_observations(take)
    assert {k.keypoint_set for k in seen.keypoints} == {"MEDIAPIPE_75"}
    (tmp_path / "c.toml").write_text(guess.text.replace('"caliscope"', '"caliscope"\nset = "MEDIAPIPE_33"'))
    plain = load_observations(read_take(tmp_path / "c.toml"))
    assert {(k.keypoint_set, len(k.names)) for k in plain.keypoints} == {("MEDIAPIPE_33", 33)}
    assert seen.frames == (0, 267) and [k.camera for k in seen.keypoints] == [f"cam_{k}" for k in range(4)]


def test_videos_alone_become_cameras_that_are_found(folder):
    for name, size in (("left", SIZE), ("right", SIZE[::-1])):
        write_video(folder / f"{name}.mp4", size)
    (folder / "static").mkdir()
    write_video(folder / "static" / "left.mp4")
    guess = guess_take(folder)
    (folder / "take.toml").write_text(guess.text)
    take = read_take(folder / "take.toml")
    assert take.calibration is None and [c.name for c in take.cameras] == ["left", "right"]
    assert all(camera.field_of_view == 64.0 for camera in take.cameras) and take.up == "z"
    assert any(note.about == "calibration" and "people in view" in note.text for note in guess.notes)


def test_a_calibration_of_one_camera_is_left_out_and_a_damaged_one_refused(folder, rig):
    write_videos(folder, ["cam01.mp4", "cam02.mp4"], frames=2)
    write_calibration(Rig((rig["cam01"],)), folder / "cam01.toml")
    (folder / "docker-compose.yml").write_text("a: [1,")  # of something else
    guess = guess_take(folder)
    assert any("cam01.toml has one camera only" in note.text for note in guess.notes)
    (folder / "cam01.toml").write_text('[cam01]\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n[cam02]\nmatrix = "x"\n')
    with pytest.raises(CalibrationError, match=r"cam01.toml.*no calibration can be used"):
        guess_take(folder)


def test_videos_of_one_name_are_not_mixed(folder):
    for place in ("one", "two"):
        write_video(folder / place / "cam.mp4")
    with pytest.raises(TakeError, match="two videos are called cam.*Name the folder of one recording"):
        guess_take(folder)


NUMBERED = ("cam1/IMG_0001.mp4", "cam1/IMG_0002.mp4", "cam2/IMG_0002.mp4", "cam2/IMG_0003.mp4")


def test_folders_are_cameras_that_count_their_own_files(folder, rig):
    write_videos(folder, NUMBERED, frames=5)
    write_calibration(renamed(Rig(rig.cameras[:2]), ("cam1", "cam2")), folder / "calib.toml")
    take, _, guess = taken(folder)
    assert [c.video.relative_to(folder).as_posix() for c in take.cameras] == [NUMBERED[0], NUMBERED[2]]
    assert any("another recording" in note.text for note in guess.notes)
    found, _ = trials([folder / name for name in NUMBERED], folder, ("cam1", "cam2"))
    assert [[p.name for p in t.files.values()] for t in found] == [["IMG_0001.mp4", "IMG_0002.mp4"],
                                                                  ["IMG_0002.mp4", "IMG_0003.mp4"]]  # fmt: skip
    assert {t.how for t in found} == {"nth"}
    found, _ = trials([folder / name for name in NUMBERED[:3]], folder, ("cam1", "cam2"))
    assert {t.how for t in found} == {"uneven"} and [len(t.files) for t in found] == [2, 1]
    (folder / "calib.toml").unlink()
    without = guess_take(folder)
    assert NUMBERED[0] in without.text and NUMBERED[2] in without.text and NUMBERED[1] not in without.text
    assert any("cam1/IMG_0002.mp4: a later recording" in note.text for note in without.notes)


def test_names_of_trials_in_folders_of_cameras_stay_names(folder):
    paths = [folder / camera / f"{trial}.mp4" for camera, some in (("cam1", ("run", "walk")), ("cam2", ("walk",)))
             for trial in some]  # fmt: skip
    found, _ = trials(paths, folder, ("cam1", "cam2"))
    assert {t.place: len(t.files) for t in found} == {"*/walk": 2, "*/run": 1}


@pytest.mark.parametrize("names", [
    ("GX010123.MP4", "GX020123.MP4"), ("GOPR0123.mp4", "GP010123.mp4", "GP020123.mp4"),
    ("GH030001.mp4", "GH040001.mp4"),
])  # fmt: skip
def test_chapters_are_one_camera(folder, names):
    write_videos(folder, names, frames=5)
    guess = guess_take(folder)
    assert names[0] in guess.text and not any(name in guess.text for name in names[1:])
    told = notes(guess, "video")
    assert all(f"{name}: a later chapter of {names[0]}" in told for name in names[1:]) and "concat" in told


def test_depth_of_a_folder_and_of_a_track(folder):
    (folder / "k").mkdir()
    image = np.tile(np.linspace(2000, 3000, 64), (48, 1)).astype(np.uint16)
    for i in range(3):
        cv2.imwrite(str(folder / "k" / f"{i}.png"), image)
    guess = guess_take(folder)
    assert 'file = "k"' in guess.text and "3 depth images of 64x48 px" in guess.text and "# intrinsics" in guess.text
    with av.open(str(folder / "rec.mkv"), "w") as container:
        for title, codec, pixels in (("COLOR", "mjpeg", "yuvj420p"), ("DEPTH", "ffv1", "gray16le")):
            stream = container.add_stream(codec, rate=30)
            (stream.width, stream.height), stream.pix_fmt, stream.metadata["title"] = (64, 48), pixels, title
        for _ in range(3):
            pictures = (np.zeros((48, 64, 3), np.uint8), "rgb24"), (image, "gray16le")
            for stream, (picture, kind) in zip(container.streams, pictures, strict=True):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format=kind)))
        for stream in container.streams:
            container.mux(stream.encode())
    both = guess_take(folder)
    assert '[[depth]]\nname = "rec"\nfile = "rec.mkv"' in both.text and '# name = "k"' in both.text
    write_video(folder / "phone.mp4", frames=5)
    beside = guess_take(folder)
    assert '# [[depth]]\n# name = "rec"' in beside.text and "[[camera]]" in beside.text


@pytest.mark.parametrize(("name", "said"), [
    (".IMG_0001.MOV.icloud", "iCloud"), ("session.zip", "an archive"), ("VID.insv", "360°"),
    ("v.mp4.crdownload", "not finished"), ("me.jpg", "12 numbered images"),
])  # fmt: skip
def test_what_stands_in_place_of_a_recording_is_named(folder, name, said):
    (folder / name).write_bytes(b"x")
    with pytest.raises(TakeError, match=rf"no videos.*{re.escape(name)}.*{said}"):
        guess_take(folder)
    write_video(folder / "phone.mp4", frames=5)
    assert name == "me.jpg" or said in notes(guess_take(folder))


def test_one_depth_image_is_a_take_of_one_pose(folder):
    cv2.imwrite(str(folder / "one.png"), np.tile(np.linspace(2000, 3000, 64), (48, 1)).astype(np.uint16))
    guess = guess_take(folder)
    assert "one.png: one depth image" in notes(guess) and 'file = "one.png"' in guess.text
    write_video(folder / "phone.mp4", frames=5)
    beside = guess_take(folder)
    assert "one depth image" in notes(beside) and "[[depth]]" not in beside.text


@pytest.mark.parametrize(("name", "size", "focal", "sure"), [
    ("D435i session", (848, 480), 425.0, "likely"), ("kinect_v2", (512, 424), 365.0, "likely"),
    ("Kinect", (640, 480), 577.0, "likely"), ("femto bolt", (640, 576), 504.0, "likely"),
    ("astra", (640, 480), 570.0, "likely"), ("depth", (640, 576), 504.0, "guess"),
    ("depth", (512, 424), 365.0, "guess"), ("depth", (640, 480), None, "open"), ("depth", (200, 100), None, "open"),
])  # fmt: skip
def test_the_lens_of_a_depth_camera_is_guessed_by_name_and_size(folder, name, size, focal, sure):
    (folder / name).mkdir()
    for i in range(2):
        row = np.linspace(2000, 3000, size[0])
        cv2.imwrite(str(folder / name / f"{i}.png"), np.tile(row, (size[1], 1)).astype(np.uint16))
    guess = guess_take(folder)
    assert f"{sure} intrinsics" in notes(guess) and "rate = 30.0" in guess.text
    if focal is None:
        assert "# intrinsics =" in guess.text and ("first Kinect" in notes(guess)) == (size == (640, 480))
        return
    (folder / "take.toml").write_text(guess.text)
    seen = load_observations(read_take(folder / "take.toml"))
    assert seen.depth[0].camera.matrix[0, 0] == focal and seen.depth[0].camera.matrix[1, 2] == (size[1] - 1) / 2


def test_images_without_motion_and_of_all_directions_are_named(folder):
    write_video(folder / "a.mp4", frames=1)
    assert "a.mp4: one frame" in notes(guess_take(folder)) and "360" not in notes(guess_take(folder))
    write_video(folder / "a.mp4", frames=3, size=(640, 320))
    assert "360° videos" in notes(guess_take(folder)) and "18:9" in notes(guess_take(folder))


def test_masks_of_16_bits_are_no_depth(folder):
    for i in range(3):
        mask = np.zeros((48, 64), np.uint16)
        mask[10:20] = 65535
        cv2.imwrite(str(folder / f"mask_{i}.png"), mask)
    with pytest.raises(TakeError, match="no videos.* among 3 files: 3 images"):
        guess_take(folder)


def test_time_codes_are_offsets_where_all_state_them(folder):
    def write_code(name, code, frames=60):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream("mpeg4", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            stream.metadata["timecode"] = code
            for _ in range(frames):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))))
            container.mux(stream.encode())

    write_code("a.mov", "10:00:00:00")
    write_code("b.mov", "10:00:00:15")
    guess = guess_take(folder)
    (folder / "take.toml").write_text(guess.text)
    assert [c.time_offset for c in read_take(folder / "take.toml").cameras] == [0.0, 0.5]
    assert any("by its time code" in note.text for note in guess.notes)
    write_code("b.mov", "12:00:00:15")  # a clock that nobody set
    assert "time_offset" not in guess_take(folder).text
    write_video(folder / "b.mov", frames=60)
    assert "time_offset" not in guess_take(folder).text


def test_numpy_files_are_depth_where_they_hold_images(folder):
    image = np.tile(np.linspace(2.0, 3.0, 64, dtype=np.float32), (48, 1))
    np.save(folder / "walk.npy", np.stack([image] * 4))
    assert 'file = "walk.npy"' in guess_take(folder).text and "4 depth images" in notes(guess_take(folder))
    np.save(folder / "walk.npy", image)
    with pytest.raises(TakeError, match=r"walk.npy: one depth image"):
        guess_take(folder)
    np.save(folder / "walk.npy", np.random.default_rng(0).random((90, 33, 4)))  # points of somebody's program
    with pytest.raises(TakeError, match=r"among 1 files\."):
        guess_take(folder)
