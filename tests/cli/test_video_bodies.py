"""From drawn videos and a bar recording to an animation, by the commands and clicked joints alone."""

import pytest
from benchmarks.accuracy.surfaces import video_bodies

from kinefit.readers.motion import read_motion


@pytest.mark.slow
def test_videos_and_a_bar_become_an_animated_arm(tmp_path):
    told = video_bodies.errors(tmp_path, "arm", 43, frames=6)
    assert told["scale"] < 0.1 and told["joints"] < 15.0 and told["joints_worst"] < 30.0
    assert told["angles_elbows_knees"] < 3.0 and told["angles_upperarms_thighs"] < 10.0  # with its own turn, as clicked
    motion = read_motion(tmp_path / "take" / "result" / "motion.npz")
    assert len(motion) == 6 and motion.up == "z" and "surface_points" in motion.residuals
    assert (tmp_path / "take" / "own.glb").read_bytes()[:4] == b"glTF"
