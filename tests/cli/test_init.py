"""`kinefit init`: from a folder to a take that tracks."""

import json
import re
import shutil
import threading
import urllib.request
from dataclasses import replace
from urllib.parse import urljoin

import cv2
import msgspec
import numpy as np
import pytest
from click.testing import CliRunner
from websockets.sync.client import connect

import kinefit.cli
from kinefit.bodies import load_body
from kinefit.cli import main
from kinefit.errors import TakeError
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import squat_and_wave


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


@pytest.fixture
def folder(take):
    """A folder as a stranger brings it: videos, keypoints, a calibration, no take file."""
    take.unlink()
    return take.parent


def test_the_take_that_it_writes_is_as_good_as_the_one_that_was_there(take, tmp_path):
    given = read_take(take)
    take.rename(tmp_path / "given.toml")
    told = run("init", take.parent)
    assert told.exit_code == 0, told.output
    guessed = read_take(take)
    assert (guessed.rate, guessed.up, guessed.body, guessed.calibration) == (
        given.rate, given.up, given.body, given.calibration,
    )  # fmt: skip
    assert guessed.cameras == given.cameras
    assert [(k.camera, k.file, k.format) for k in guessed.keypoints] == [
        (k.camera, k.file, k.format) for k in given.keypoints
    ]
    assert load_observations(guessed).frames == load_observations(given).frames
    assert f"{take}: written" in told.stdout and "kinefit check" in told.stdout
    assert "sure    camera cam01" in told.stdout


def test_a_take_file_is_replaced_only_by_force(folder):
    assert run("init", folder).exit_code == 0
    (folder / "take.toml").write_text("mine")
    told = run("init", folder)
    assert told.exit_code == 2 and "the take file already exists" in told.stderr and "--force" in told.stderr
    assert (folder / "take.toml").read_text() == "mine"
    assert run("init", folder, "--force").exit_code == 0
    assert read_take(folder / "take.toml").cameras


def test_paths_start_at_the_take_file(folder, tmp_path):
    assert run("init", folder, "--out", tmp_path / "takes" / "monday.toml").exit_code == 0
    text = (tmp_path / "takes" / "monday.toml").read_text()
    assert 'file = "../take/calibration.toml"' in text
    assert load_observations(read_take(tmp_path / "takes" / "monday.toml")).rig is not None
    assert not (folder / "take.toml").exists()


def test_a_folder_of_nothing_is_told_and_nothing_written(tmp_path):
    (tmp_path / "empty").mkdir()
    for args in ([tmp_path / "empty"], [tmp_path / "none"]):
        told = run("init", *args)
        assert told.exit_code == 2 and "error: " in told.stderr and "try" in told.stderr
    assert not list((tmp_path / "empty").iterdir())


def test_videos_alone_are_told_how_to_calibrate(folder):
    (folder / "calibration.toml").unlink()
    told = run("init", folder)
    assert told.exit_code == 2
    assert "kinefit calibrate board" in told.stderr and "kinefit calibrate people" in told.stderr
    assert not (folder / "take.toml").exists()


def test_a_damaged_video_is_told(folder):
    (folder / "cam02.mp4").write_bytes((folder / "cam02.mp4").read_bytes()[:5000])
    told = run("init", folder)
    assert told.exit_code == 2 and "cam02.mp4" in told.stderr
    assert not (folder / "take.toml").exists()


@pytest.mark.slow
def test_what_it_writes_can_be_tracked(folder, tmp_path):
    assert run("init", folder).exit_code == 0
    told = run("track", folder / "take.toml", "--no-overlays", "--formats", "motion", "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    motion = kinefit.read_motion(tmp_path / "out" / "motion.npz")
    truth = squat_and_wave()
    knees = [motion.body.tree.segment(f"shank_{side}") for side in "rl"]
    off = motion.segment_poses()[:, knees, :3, 3] - truth.segment_poses()[:, knees, :3, 3]
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.03


@pytest.mark.slow
def test_one_video_of_a_telephone_can_be_tracked(tmp_path, data_dir):
    """A real walk towards the camera, as it is: nothing is lost, knees bend, feet stand."""
    shutil.copy(data_dir("video_mono_opencap") / "walk_ts" / "video.mp4", tmp_path / "walk.mp4")
    told = run("init", tmp_path)
    assert told.exit_code == 0 and "walk.mp4 alone" in told.stdout, told.output
    told = run("track", tmp_path / "take.toml", "--formats", "motion", "--out", tmp_path / "out")
    assert told.exit_code == 0 and "field of view of 64°" in told.output, told.output
    motion = kinefit.read_motion(tmp_path / "out" / "motion.npz")
    assert motion.lost.mean() < 0.05 and motion.quality.mean() > 0.8
    knee = motion.angles[:, motion.body.tree.coordinate("knee_angle_r")]
    assert 0.5 < np.ptp(knee) < 1.6  # [rad] of a walk: 60 degrees, give or take
    walked = motion.joint_centres[-1, 0] - motion.joint_centres[0, 0]
    assert 0.8 < np.linalg.norm(walked) < 2.5 and walked[1] < 0.0  # a second and a half, towards the camera


def clicked(folder, motion, frame=3, names=None):
    """Clicks on the joints of a drawn take, as JSON has them."""
    from kinefit.fitting.initialization.from_points import clickable

    body, seen = motion.body, load_observations(read_take(folder / "take.toml"))
    points = body.landmarks.select(names or clickable(body))
    x = motion.positions(points)[frame]
    uv = {c.name: c.project(x) for c in tuple(seen.rig)[:3]}
    return {"step": frame, "points": {c: dict(zip(points.names, p.tolist())) for c, p in uv.items()}}


def test_clicked_joints_give_body_and_start(folder, tmp_path):
    motion = squat_and_wave()
    assert run("init", folder).exit_code == 0
    told = clicked(folder, motion)
    (tmp_path / "clicks.json").write_text(json.dumps(told))
    answer = run("init", folder, "--points", tmp_path / "clicks.json", "--force")
    assert answer.exit_code == 0, answer.output
    assert "points triangulated" in answer.stdout
    take = read_take(folder / "take.toml")
    assert take.pose.step == 3 and take.body == str(folder / "clicked-body.npz")
    body = load_body(take.body)
    recording, _ = recording_of(take, load_observations(take), body)
    step, state = recording.start
    assert step == 3 - load_observations(take).frames[0]
    joints = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]
    assert np.linalg.norm(joints - motion.joint_centres[3], axis=1).max() < 0.05
    told["points"]["cam02"]["r_knee"][0] += 60.0
    told["points"]["cam02"]["r_knee"][1] += 90.0
    (tmp_path / "clicks.json").write_text(json.dumps(told))
    answer = run("init", folder, "--points", tmp_path / "clicks.json", "--force")
    assert answer.exit_code == 2 and "r_knee: camera cam02 is off by" in answer.stderr
    (tmp_path / "clicks.json").write_text('{"points": {"cam02": {"r_knee": [1]}}}')
    answer = run("init", folder, "--points", tmp_path / "clicks.json", "--force")
    assert answer.exit_code == 2 and "[1] is not a pixel position" in answer.stderr


def test_clicks_are_measurements_of_their_frames(folder, tmp_path):
    """Clicks of two frames stay with the take: each frame of them alone gives the pose that was clicked there."""
    from kinefit.fitting.tracking.take_recording import recording_of
    from kinefit.observations import LineFrame

    motion = squat_and_wave()
    assert run("init", folder).exit_code == 0
    rng, looks = np.random.default_rng(0), [clicked(folder, motion, frame) for frame in (3, 20)]
    for look in looks:
        for points in look["points"].values():
            for place in points.values():
                place[:] = (np.array(place) + 2.0 * rng.normal(size=2)).tolist()
    (tmp_path / "both.json").write_text(json.dumps(looks[::-1]))  # in any order
    answer = run("init", folder, "--points", tmp_path / "both.json", "--force")
    assert answer.exit_code == 0, answer.output
    take = read_take(folder / "take.toml")
    assert take.pose.step == 3 and take.pose.clicks == folder / "clicks.json"
    seen = load_observations(take)
    video = next(video for video in seen.clicks if video.sensor == "cam02")
    name, (u, v) = next(iter(looks[1]["points"]["cam02"].items()))
    k = video.names.index(f"{name} u")
    np.testing.assert_allclose(video.frame(1).ends[k, :, 0], u, atol=0.01)
    np.testing.assert_allclose(video.frame(1).ends[k + 1, :, 1], v, atol=0.01)
    assert video.landmarks[k] == video.landmarks[k + 1] == (name,)
    body = load_body(take.body)
    recording, body = recording_of(take, seen, body)
    assert recording.sigma["clicks cam02"] == 3.0
    first, tracker = seen.frames[0], kinefit.Tracker(body, recording.rig, rate=30.0, up="z", sigma=recording.sigma)
    tracker.start_at(recording.start[1])
    frames = [[f for f in recording.steps(step - first) if isinstance(f, LineFrame)] for step in (3, 20)]
    assert [len(of) for of in frames] == [3, 3]
    for step, of in zip((3, 20), frames):
        state = tracker.update(of).state
        joints = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]
        limbs = [body.tree.segment(f"{part}_{side}") for part in ("forearm", "hand", "shank", "foot") for side in "rl"]
        off = np.linalg.norm(joints - motion.joint_centres[step], axis=1)[limbs]
        assert off.max() < 0.04, (step, off)
    moved = np.linalg.norm(motion.joint_centres[3] - motion.joint_centres[20], axis=1)
    assert moved.max() > 0.1  # the second frame is not the start


def test_clicks_that_no_pose_has_are_told(folder, tmp_path):
    motion = squat_and_wave()
    assert run("init", folder).exit_code == 0
    told = clicked(folder, motion)

    def answered(change):
        other = json.loads(json.dumps(told))
        change(other["points"])
        (tmp_path / "clicks.json").write_text(json.dumps(other))
        return run("init", folder, "--points", tmp_path / "clicks.json", "--force")

    def exchanged(points):
        for of in points.values():
            for name in ("hip", "knee", "ankle"):
                of[f"r_{name}"], of[f"l_{name}"] = of[f"l_{name}"], of[f"r_{name}"]

    assert "Warning" not in answered(lambda points: None).stdout
    answer = " ".join(answered(exchanged).stdout.split())
    assert "Warning: no pose of this body fits the clicks" in answer and "left and right are swapped" in answer
    answer = answered(lambda points: points["cam02"].update(knie=[10.0, 20.0]))
    assert answer.exit_code == 2 and "'knie'" in answer.stderr
    answer = answered(lambda points: points["cam02"].update(r_thigh_front=[10.0, 20.0]))
    assert "Not used, as clicked in one image only: r_thigh_front" in " ".join(answer.stdout.split())


def test_joints_are_clicked_in_the_browser(folder, monkeypatch):
    assert run("init", folder).exit_code == 0
    right, seen = clicked(folder, squat_and_wave(), frame=0), {}
    wrong = json.loads(json.dumps(right))
    for place in wrong["points"]["cam03"].values():
        place[0] += 40.0
        place[1] += 80.0

    def browser(opening):
        with urllib.request.urlopen(opening, timeout=20) as answer:  # a one-time address, which leads to the page
            url = urljoin(opening, answer.headers["Refresh"].removeprefix("0; url="))

        def ask(path):
            with urllib.request.urlopen(url + path, timeout=20) as answer:
                return answer.read(), answer.headers["Content-Security-Policy"]

        seen["page"], seen["policy"] = ask("")
        seen["files"] = [ask(name)[0] for name in re.findall(r'(?:href|src)="([^"]*)"', seen["page"].decode())]
        seen["picture"] = cv2.imdecode(np.frombuffer(ask("picture/cam02")[0], np.uint8), 1).shape
        with connect(url.replace("http", "ws", 1)) as page:
            seen["asked"], seen["answers"] = json.loads(page.recv(20.0)), []
            for told in ("[" * 30_000, json.dumps(wrong), json.dumps(right)):
                page.send(told)
                seen["answers"].append(json.loads(page.recv(20.0)))

    threads = []

    def opened(url):
        threads.append(threading.Thread(target=browser, args=(url,)))
        threads[-1].start()

    monkeypatch.setattr("webbrowser.open", opened)
    answer = run("init", folder, "--click", "--force")
    threads[0].join(20.0)  # the command may end before the browser has read its last answer
    assert answer.exit_code == 0, answer.output
    assert seen["asked"]["cameras"] == ["cam01", "cam02", "cam03", "cam04"] and "r_knee" in seen["asked"]["joints"]
    assert seen["picture"] == (960, 544, 3) and "unsafe" not in seen["policy"]
    assert len(seen["files"]) == 2 and b"<style" not in seen["page"] and b"<script>" not in seen["page"]
    assert [a["taken"] for a in seen["answers"]] == [False, False, True]
    assert "These clicks cannot be used" in seen["answers"][0]["answer"]
    assert "Camera cam03 is off in" in seen["answers"][1]["answer"]
    assert read_take(folder / "take.toml").pose is not None
    assert json.loads((folder / "clicks.json").read_text())["points"]["cam01"]


def test_joints_are_clicked_in_images_of_one_time_alone(folder):
    from kinefit.cli.init import _pictures

    assert run("init", folder).exit_code == 0
    take = read_take(folder / "take.toml")
    seen = load_observations(take)
    assert list(_pictures(take, seen, 0)) == ["cam01", "cam02", "cam03", "cam04"]

    def late(names):
        cameras = [msgspec.structs.replace(c, time_offset=1.0 if c.name in names else 0.0) for c in take.cameras]
        return replace(take, cameras=tuple(cameras))

    assert list(_pictures(late({"cam02"}), seen, 0)) == ["cam01", "cam03", "cam04"]
    with pytest.raises(TakeError, match="1 of 4 cameras have an image at step 0"):
        _pictures(late({"cam01", "cam02", "cam03"}), seen, 0)


def test_options_of_clicks_that_do_not_fit(folder, tmp_path):
    for words, problem in ((["--step", 3], "--step needs --click"), (["--body", "arm"], "--body needs --click"),
                           (["--click", "--points", "x"], "give one")):  # fmt: skip
        answer = run("init", folder, *words)
        assert answer.exit_code == 2 and problem in answer.stderr
    answer = run("init", folder, "--points", tmp_path / "x.json")
    assert answer.exit_code == 2 and "no such file" in answer.stderr


def test_a_surface_that_was_followed_is_entered(folder):
    (folder / "surface").mkdir()
    (folder / "surface" / "trajectories.csv").write_text(
        "time_s,point,x,y,z,std_x,std_y,std_z\n0.0,1,0,0,0,0.001,0.001,0.001\n"
    )
    assert "surface/trajectories.csv" in run("init", folder).stdout
    entries = read_take(folder / "take.toml").sensors["surface_points"]
    assert [entry.file.name for entry in entries] == ["trajectories.csv"]
