"""`kinefit live` on a drawn take: replayed, streamed, left as a motion; and what it refuses."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.readers.motion import read_motion


@pytest.fixture
def run():
    def call(*words):
        return CliRunner().invoke(main, ["live", *map(str, words)])

    return call


def test_a_take_is_replayed_and_left_as_a_motion(run, take, tmp_path):
    out, lines = tmp_path / "out", tmp_path / "poses.jsonl"
    result = run(take, "--speed", "0", "--port", "0", "--out", out, "--json", lines)
    assert result.exit_code == 0, result.output
    packets = [json.loads(line) for line in lines.read_text().splitlines()]
    poses = [p for p in packets if p["type"] == "pose"]
    motion = read_motion(out / "motion.npz")
    assert packets[0]["type"] == "hello" and len(motion) == len(poses) > 0
    places = motion.segment_poses()[:, :, :3, 3]
    assert np.allclose([np.array(p["segments"])[:, :3] for p in poses], places, atol=2e-5)
    assert "0 of" in result.output and "page and poses at http://localhost:" in result.output


def test_the_address_has_the_token_and_a_server_for_all_networks_warns(run, take, tmp_path):
    """The session is over after one frame: nobody is to connect."""
    token = "a-token-of-24-characters"
    words = (take, "--seconds", "0.01", "--port", "0", "--no-record", "--token", token)
    local, wide = run(*words), run(*words, "--host", "0.0.0.0")
    assert local.exit_code == wide.exit_code == 0, wide.output
    assert all(f"/{token}/\n" in result.stdout for result in (local, wide))
    assert "warning" not in local.output and "warning: The server at 0.0.0.0 is open to the network" in wide.stderr


def test_lines_on_the_standard_output_stand_alone(run, take, tmp_path):
    result = run(take, "--speed", "0", "--no-page", "--no-record", "--json", "-")
    assert result.exit_code == 0
    assert all(json.loads(line)["type"] for line in result.stdout.splitlines())
    assert not take.with_name("take-live").exists()


def test_seconds_end_a_session(run, take, tmp_path):
    result = run(take, "--seconds", "0.2", "--speed", "0.05", "--no-page", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--vmc", "localhost"), "HOST:PORT"), (("--vmc", "localhost:99999"), "HOST:PORT"),
        (("--host", "256.0.0.1"), "server cannot start"), (("--speed", "-1"), "speed"),
        (("--json", "/"), "cannot be written"), (("--token", "short"), "16 to 128 letters"),
    ],
)
def test_what_cannot_be_is_refused(run, take, words, told):
    result = run(take, *words)
    assert result.exit_code == 2 and told in result.output


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("[[camera]]", '[[camera]]\nstream = "0"', "a stream and a video"),
        ('[take]\n', '[take]\nperson = "moving"\n', "needs the whole recording"),
    ],
)
def test_takes_that_cannot_be_live_are_refused(run, take, change, old, new, told):
    text = take.read_text()
    take.write_text(text.replace(old, new, 1))
    result = run(take, "--no-page", "--no-record")
    assert result.exit_code == 2 and told in result.output, result.output


def test_a_take_of_streams_is_not_for_track(take):
    text = take.read_text()
    head = text[: text.index("[[keypoints]]")]
    take.write_text("\n".join('stream = "0"' if line.startswith("video") else line for line in head.splitlines()))
    result = CliRunner().invoke(main, ["track", str(take)])
    assert result.exit_code == 2 and "kinefit live" in result.output
