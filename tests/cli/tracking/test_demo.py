"""`kinefit demo` and `kinefit warmup`."""

import re

import pytest
from click.testing import CliRunner

import kinefit
from kinefit.cli import main
from kinefit.errors import AssetError, command
from kinefit.readers import assets


@pytest.fixture
def no_overlays(monkeypatch):
    """Overlays are the slow part, and test_track.py sees to them."""
    monkeypatch.setattr("kinefit.takes.batch.results.write_overlays", lambda *args, **more: None)


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


def test_the_drawn_figure_needs_nothing_fetched(tmp_path, monkeypatch, no_overlays):
    monkeypatch.setattr(assets, "sample_recording", pytest.fail)
    told = run("demo", "--synthetic", "--out", tmp_path / "demo")
    assert told.exit_code == 0, told.output
    assert len(kinefit.read_motion(tmp_path / "demo" / "motion.npz")) == 60
    assert (tmp_path / "demo" / "take" / "take.toml").is_file()
    assert "No recording of a person" in (tmp_path / "demo" / "take" / "take.toml").read_text()
    for name in ("motion.bvh", "tables", "report.html", "overlays"):
        assert str(tmp_path / "demo" / name) in told.stdout
    assert command("check", tmp_path / "demo" / "take" / "take.toml") in told.stdout


def test_where_the_recording_cannot_be_had_the_drawn_figure_takes_its_place(tmp_path, monkeypatch, no_overlays):
    def fetch(progress=None):
        raise AssetError("the index cannot be reached", remedy="Check the network.")

    monkeypatch.setattr(assets, "sample_recording", fetch)
    told = run("demo", "--out", tmp_path / "demo")
    assert told.exit_code == 0, told.output
    assert "error: the index cannot be reached\n   try Check the network." in told.stderr
    assert "simulated figure is tracked instead" in told.stderr
    assert "squat_and_wave: 60 frames" in told.stdout


def test_the_real_recording_is_tracked_with_its_credit_on_screen(tmp_path, monkeypatch, data_dir, no_overlays):
    recording = data_dir("video_balancing_4cam")
    monkeypatch.setattr(assets, "sample_recording", lambda progress=None: recording)
    told = run("demo", "--out", tmp_path / "demo")
    assert told.exit_code == 0, told.output
    for text in ("David Pagnon", "BSD-3-Clause", "MediaPipe", "Calib_refined_static.toml is used in place of"):
        assert text in told.stdout
    motion = kinefit.read_motion(tmp_path / "demo" / "motion.npz")
    assert len(motion) == 100
    assert motion.quality.min() > 0.4
    swaps = int(re.search(r"^cam02 .* (\d+) frames", told.stdout, re.M)[1])
    assert 26 <= swaps <= 36
    assert "doubtful moments: " in told.stdout


@pytest.mark.slow
def test_warmup_says_how_long_it_took_and_where_the_kernels_are():
    told = run("warmup")
    assert told.exit_code == 0, told.output
    assert re.fullmatch(r"ready after \d+\.\d s; kernels are in .*kernels\n", told.stdout)
