"""Folders that fill up: images, depth, keypoints; a recording that another program writes while it is followed."""

import json
import os
import shutil
import threading
import time

import cv2
import numpy as np
import pytest
from tests.docs.drawn import write_openpose
from tests.studio.live.taking import image, taken

from kinefit.errors import FileError, ObservationError, TakeError
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import TOF, cut, in_front, simulate_depth, squat_and_wave
from kinefit.studio.live.cameras import Inbox, SessionClock
from kinefit.studio.live.folders import DepthFolderStream, ImageFolderStream, KeypointFolderStream
from kinefit.studio.live.take import live_session


def test_new_images_of_a_folder_are_taken_once_and_in_order(tmp_path):
    cv2.imwrite(str(tmp_path / "old_1.png"), image(1))
    inbox = Inbox(["cam"], patience=0.0)
    stream = ImageFolderStream("cam", tmp_path, (64, 48), SessionClock())
    stream.start(inbox)
    seen = []
    for k in (9, 10, 11):
        cv2.imwrite(str(tmp_path / f"new_{k}.png"), image(k))
        seen += taken(inbox, 1)
    stream.stop()
    assert [int(one.seen[0, 0, 0]) for one in seen] == [9, 10, 11]
    assert all(np.diff([one.time for one in seen]) > 0)
    assert inbox.came == {"cam": 3}


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(FileError, match="no such folder"):
        ImageFolderStream("cam", tmp_path / "nowhere", (64, 48), SessionClock())


def test_of_many_new_files_the_last_is_read_and_the_others_are_counted(tmp_path):
    inbox = Inbox(["tof"], patience=0.0)
    stream = DepthFolderStream("tof", tmp_path, (64, 48), SessionClock(), near=0.5, far=3.0)
    for k in range(5):  # before it looks for the first time
        cv2.imwrite(str(tmp_path / f"depth_{8 + k}.png"), np.full((48, 64), 1000 + k, np.uint16))
    time.sleep(0.1)
    stream.start(inbox)
    (one,) = taken(inbox, 1)
    stream.stop()
    assert one.seen[0].depth[0, 0] == pytest.approx(1.004)
    assert inbox.came == {"tof": 5} and inbox.dropped == {"tof": 4}


def test_units_ranges_and_damage_of_depth_images(tmp_path):
    stream = DepthFolderStream("tof", tmp_path, (64, 48), SessionClock(), near=0.5, far=3.0)
    counts = np.full((48, 64), 2000, np.uint16)
    counts[0], counts[1] = 4000, 65535
    cv2.imwrite(str(tmp_path / "a.png"), counts)
    cv2.imwrite(str(tmp_path / "b.tiff"), (counts * 0.001).astype(np.float32))
    for name in ("a.png", "b.tiff"):
        depth = stream.read(tmp_path / name, 1.5)[0]
        assert depth.time == 1.5 and not depth.depth[:2].any() and np.allclose(depth.depth[2:], 2.0)
    (tmp_path / "c.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    assert stream.read(tmp_path / "c.png", 0.0) is None
    cv2.imwrite(str(tmp_path / "d.png"), image(3))
    with pytest.raises(ObservationError, match="not a depth image"):
        stream.read(tmp_path / "d.png", 0.0)
    cv2.imwrite(str(tmp_path / "e.png"), counts[:20])
    with pytest.raises(ObservationError, match="images have 64x20 px instead of 64x48"):
        stream.read(tmp_path / "e.png", 0.0)


def test_keypoints_of_nobody_damaged_and_of_another_set(tmp_path):
    stream = KeypointFolderStream("cam", tmp_path, SessionClock(), keypoint_set="BODY_25B", rate=30.0)
    (tmp_path / "a_000.json").write_text(json.dumps({"people": []}))
    (nobody,) = stream.read(tmp_path / "a_000.json", 2.0)
    assert nobody.points.shape == (1, 0, 25, 2) and nobody.times[0] == 2.0
    (tmp_path / "b_001.json").write_text('{"people": [{"pose_keypoints_2d": [1, 2')
    assert stream.read(tmp_path / "b_001.json", 2.0) is None
    (tmp_path / "c_002.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": [1.0] * 51}]}))
    with pytest.raises(ObservationError, match="COCO_17"):
        stream.read(tmp_path / "c_002.json", 2.0)


def test_a_folder_that_is_taken_away_ends_the_session_with_its_name(tmp_path):
    (tmp_path / "gone").mkdir()
    inbox = Inbox(["tof"], patience=0.0)
    stream = DepthFolderStream("tof", tmp_path / "gone", (64, 48), SessionClock())
    (tmp_path / "gone").rmdir()
    stream.start(inbox)
    with pytest.raises(FileError, match="gone.*can no longer be read"):
        taken(inbox, 1)
    stream.stop()


class Writer:
    """Another program: puts files of a recording into folders at a rate [Hz], the second half after a first pose."""

    def __init__(self, recorded, rate):
        self.recorded, self.rate, self.written = recorded, rate, 0

    def run(self, collected):
        for k, files in enumerate(self.recorded):
            time.sleep(1 / self.rate)
            if 2 * k == len(self.recorded):
                wait(lambda: any(posed.result is not None for posed in collected.poses))
            for source, folder in files:
                shutil.copyfile(source, folder / source.name)
                self.written += 1


def wait(until):
    end = time.monotonic() + 20.0
    while not until() and time.monotonic() < end:
        time.sleep(0.02)


def follow(take, writer, collected):
    session = live_session(read_take(take), [collected])

    def until_all_came():
        writer.run(collected)
        wait(lambda: sum(session.inbox.came.values()) >= writer.written)
        session.ask({"stop": True})  # after the step with what waits

    thread = threading.Thread(target=until_all_came, daemon=True)
    thread.start()
    session.run(60.0)
    thread.join()
    return session


def test_keypoints_that_a_detector_writes_are_followed(scene, collected, tmp_path):
    write_calibration(scene.rig, tmp_path / "calibration.toml")
    parts = [f'[take]\nrate = 10.0\nup = "{scene.motion.up}"\nsize = false\n[calibration]\nfile = "calibration.toml"\n']
    for k in scene.keypoints:
        write_openpose(tmp_path / "recorded" / k.camera, k)
        (tmp_path / "new" / k.camera).mkdir(parents=True)
        parts.append(f'[[camera]]\nname = "{k.camera}"\n[[keypoints]]\ncamera = "{k.camera}"\nsigma = 2.0\n')
        parts.append(f'stream = "new/{k.camera}"\n')
    (tmp_path / "take.toml").write_text("".join(parts))
    files = [sorted((tmp_path / "recorded" / k.camera).iterdir()) for k in scene.keypoints]
    recorded = [[(path, tmp_path / "new" / path.parent.name) for path in step] for step in zip(*files)]
    writer = Writer(recorded[:12], 10.0)
    session = follow(tmp_path / "take.toml", writer, collected)
    came, dropped = sum(session.inbox.came.values()), sum(session.inbox.dropped.values())
    assert came == writer.written == 12 * len(files) and dropped < came
    found = [posed for posed in collected.poses if posed.result is not None]
    assert len(found) >= 2
    truth = scene.motion.segment_poses()[11, :, :3, 3]
    assert np.linalg.norm(found[-1].Ts_world_segment[:, :3, 3] - truth, axis=1).mean() < 0.05


def test_depth_images_that_a_program_writes_are_followed(collected, tmp_path):
    motion = cut(squat_and_wave(rate=10.0), 0, 6)
    camera = in_front(motion, TOF.camera(), near=TOF.near, far=TOF.far)
    video = simulate_depth(motion, camera, TOF, seed=1)
    (tmp_path / "recorded").mkdir()
    (tmp_path / "new").mkdir()
    recorded = []
    for i in range(len(motion)):
        path = tmp_path / "recorded" / f"{i}.png"
        cv2.imwrite(str(path), np.rint(1000 * video.frame(i).depth).astype(np.uint16))
        recorded.append([(path, tmp_path / "new")])
    write_calibration(Rig((camera,)), tmp_path / "calibration.toml")
    root = motion.Ts_world_root[0]
    (tmp_path / "take.toml").write_text(
        f'[take]\nrate = 10.0\nup = "{motion.up}"\nsize = false\n[calibration]\nfile = "calibration.toml"\n'
        f"[start]\nat = {root[:3, 3].tolist()}\nforward = {root[:3, 0].tolist()}\n"
        f'[[depth]]\nname = "tof"\ncamera = "{camera.name}"\nstream = "new"\nsigma = 0.02\n'
    )
    writer = Writer(recorded, 4.0)
    session = follow(tmp_path / "take.toml", writer, collected)
    assert session.inbox.came == {"tof": 6}
    assert session.processed == 6 - session.inbox.dropped["tof"] >= 1
    found = [posed for posed in collected.poses if posed.result is not None]
    truth = motion.segment_poses()[5, :, :3, 3]
    assert np.linalg.norm(found[-1].Ts_world_segment[:, :3, 3] - truth, axis=1).mean() < 0.08


DEPTH = '[[depth]]\nname = "tof"\nintrinsics = [1.0, 1.0, 5.0, 5.0]\n'


STREAM = DEPTH + 'stream = "new"\n'
CAMERA = '[[camera]]\nname = "a"\n'
KEYPOINTS = '[[keypoints]]\ncamera = "a"\nstream = "new"\n'


@pytest.mark.parametrize(("text", "told"), [
    (DEPTH, "neither a file nor a stream"), (STREAM, "a stream with intrinsics, and no size"),
    (STREAM + 'file = "old.npz"\nsize = [10, 10]\n', "a stream and a file"),
    (STREAM + 'size = [10, 10]\n[[markers]]\nfile = "a.trc"\n', "a recording cannot be combined with streams"),
    (STREAM + 'size = [10, 10]\n[[plate]]\nfile = "a.mot"\n', "a recording cannot be combined with streams"),
    (STREAM + 'size = [10, 10]\n[start]\nclicks = "clicks.json"\n', "a recording cannot be combined with streams"),
    (CAMERA + KEYPOINTS + 'format = "mediapipe"\n', "'stream' has no use"),
    (CAMERA + 'stream = "0"\n' + KEYPOINTS, "its camera also has a stream"),
])  # fmt: skip
def test_streams_beside_what_excludes_them(tmp_path, text, told):
    (tmp_path / "take.toml").write_text(text)
    with pytest.raises(TakeError, match=told):
        read_take(tmp_path / "take.toml")


def test_a_stream_is_no_recording(tmp_path):
    (tmp_path / "take.toml").write_text(STREAM + 'size = [10, 10]\n')
    with pytest.raises(TakeError, match="a stream is no recording.*kinefit live"):
        load_observations(read_take(tmp_path / "take.toml"))
    with pytest.raises(FileError, match="no such folder"):
        live_session(read_take(tmp_path / "take.toml"))


@pytest.mark.parametrize("ahead", [3600.0, 2.0, -3600.0])
def test_files_of_another_computers_clock_are_taken_when_they_come(tmp_path, ahead):
    inbox = Inbox(["cam"], patience=0.0)
    stream = ImageFolderStream("cam", tmp_path, (64, 48), SessionClock())
    stream.start(inbox)
    seen = []
    for k in (1, 2, 3):
        path = tmp_path / f"new_{k}.png"
        cv2.imwrite(str(path), image(k))
        for one in (path, tmp_path):
            os.utime(one, (time.time() + ahead, time.time() + ahead))
        seen += taken(inbox, 1)
    stream.stop()
    assert [int(one.seen[0, 0, 0]) for one in seen] == [1, 2, 3] and inbox.came == {"cam": 3}


def test_a_file_that_grows_is_taken_once_it_is_whole_and_a_pipe_never(tmp_path):
    stream = ImageFolderStream("cam", tmp_path, (64, 48), SessionClock())
    os.mkfifo(tmp_path / "pipe.png")
    file = tmp_path / "a.png"
    for length in (1, 2, 3):
        file.write_bytes(bytes(length))
        assert stream._new() == []
        (since,) = [since for _, since in stream._waiting.values()]
        assert stream._waiting == {"a.png": ((length, file.stat().st_mtime_ns), since)}
    time.sleep(0.06)
    assert stream._new() == [file] and stream._new() == []
