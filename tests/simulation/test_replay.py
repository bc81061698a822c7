"""A motion on a slope: inclined as a whole, carried as told, filmed."""

import av
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.errors import ExportError, ObservationError
from kinefit.exporters.motion_file import write_motion
from kinefit.readers.motion import read_motion
from kinefit.simulation.figures import film, replayed, write_video
from kinefit.simulation.movements import squat_and_wave


@pytest.fixture(scope="module")
def motion():
    return squat_and_wave(rate=25.0, duration=0.4, up="z")


@pytest.mark.parametrize("slope", [0.0, 30.0, -20.0])
def test_all_is_inclined_and_carried_down_the_fall_line(motion, slope):
    moved = replayed(motion, slope=slope, heading=40.0, speed=3.0, gain=2.0)
    a, b = motion.positions(), moved.positions()
    between = lambda x: np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    np.testing.assert_allclose(between(a), between(b), atol=1e-12)  # of one body, rigidly moved
    t = motion.times - motion.times[0]
    still = replayed(motion, slope=slope, heading=40.0)
    way = (b - still.positions()).mean(axis=1)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 3.0 * t + t**2, atol=1e-12)
    np.testing.assert_allclose(way[:, 2], -np.sin(np.radians(slope)) * (3.0 * t + t**2), atol=1e-12)
    up = still.Ts_world_root[0, :3, :3] @ motion.Ts_world_root[0, :3, :3].T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up[2])) == pytest.approx(abs(slope), abs=1e-4)
    np.testing.assert_allclose((moved.joint_std**2).sum(axis=2), (motion.joint_std**2).sum(axis=2), atol=1e-12)


@pytest.mark.parametrize("wrong", [{"slope": 90.0}, {"speed": np.inf}, {"gain": np.nan}])
def test_what_cannot_be_is_told(motion, wrong):
    with pytest.raises(ObservationError, match="Give a slope below 90"):
        replayed(motion, **wrong)


def test_a_film_shows_the_person_on_the_slope(motion, tmp_path):
    film(replayed(motion, speed=2.0), tmp_path / "ride.mp4", size=(320, 240))
    with av.open(str(tmp_path / "ride.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == len(motion) and frames[0].shape == (240, 320, 3)
    middle = frames[4][80:160, 130:190].reshape(-1, 3).astype(int)
    assert np.mean(middle[:, 2] < 160) > 0.1  # darker than the sky
    low = frames[4][-40:].reshape(-1, 3).astype(int)
    assert np.mean(np.abs(low - (226, 232, 240)).max(axis=1) < 12) > 0.5  # snow below, in RGB
    with pytest.raises(ExportError, match=r"\.mp4"):
        film(motion, tmp_path / "ride.gif")


def test_the_scene_stands_beside_a_video_of_the_same_frames(motion, tmp_path):
    """P1 figure 4: the estimate in a virtual scene beside the image, frame by frame."""
    greys = 40 + 20 * np.arange(len(motion))  # frame k has one grey of its own
    images = (np.full((120, 160, 3), grey, np.uint8) for grey in greys)
    write_video(tmp_path / "camera.mp4", images, motion.rate, (160, 120))
    write_motion(motion, tmp_path / "motion.npz")
    run = lambda *words: CliRunner().invoke(main, ["replay", str(tmp_path / "motion.npz"), *words])
    level = ["--slope", "0", "--speed", "0", "--beside", str(tmp_path / "camera.mp4")]
    done = run("-o", str(tmp_path / "both.mp4"), *level)
    assert done.exit_code == 0, done.output
    with av.open(str(tmp_path / "both.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == len(motion) and frames[0].shape == (720, 960 + 960, 3)
    shown = [f[:, 20:940].mean() for f in frames]
    np.testing.assert_allclose(shown, greys, atol=8.0)  # two lossy encodings; the next frame is 20 off
    assert all(f[:, 980:].std() > 10.0 for f in frames)  # sky, floor and person
    assert run("-o", str(tmp_path / "both.npz"), *level).exit_code == 2
    longer = squat_and_wave(rate=25.0, duration=2.0, up="z")
    with pytest.raises(ObservationError, match=r"camera.mp4.*the video ends at"):
        film(longer, tmp_path / "long.mp4", beside=tmp_path / "camera.mp4")


def test_the_command_writes_motions_and_videos(motion, tmp_path):
    write_motion(motion, tmp_path / "motion.npz")
    run = lambda *words: CliRunner().invoke(main, ["replay", str(tmp_path / "motion.npz"), *words])
    assert run("-o", str(tmp_path / "ride.npz"), "--slope", "20").exit_code == 0
    assert read_motion(tmp_path / "ride.npz").provenance["replay"]["slope"] == 20.0
    assert run("-o", str(tmp_path / "ride.mp4")).exit_code == 0 and (tmp_path / "ride.mp4").stat().st_size > 1000
    assert run("-o", str(tmp_path / "ride.avi")).exit_code == 2
