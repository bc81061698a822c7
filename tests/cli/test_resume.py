"""`kinefit track` goes on where it was stopped."""

import os

from click.testing import CliRunner
from tests.fitting.tracking.checkpoints.test_checkpoint import assert_same

from kinefit import read_motion
from kinefit.cli import main
from kinefit.fitting.tracking import run as running
from kinefit.fitting.tracking.checkpoints.checkpoint import key_of
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.readers.take.file import read_take
from kinefit.takes.batch import one


def test_its_key_tells_files_and_options(take):
    whole = read_take(take)
    key = key_of(whole, smooth=True)
    assert key == key_of(read_take(take), smooth=True) and key != key_of(whole, smooth=False)
    calibration = whole.calibration.file
    os.utime(calibration, (1, 1))
    assert key_of(whole, smooth=True) != key


def test_the_command_goes_on_after_ctrl_c(take, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "_EVERY", 4)
    words = ["track", str(take), "--no-overlays", "--no-report", "--formats", "motion", "--out"]
    left = tmp_path / "whole" / "unfinished"
    left.mkdir(mode=0o700, parents=True)
    (left / "frames.kinefit").write_bytes(b"damaged")
    told = CliRunner().invoke(main, [*words, str(tmp_path / "whole")])
    assert told.exit_code == 0 and "all frames are tracked again" in " ".join(told.output.split()), told.output
    update, count = Tracker.update, []

    def until(self, frames, time=None, **more):
        count.append(time)
        if len(count) == 30:
            raise KeyboardInterrupt
        return update(self, frames, time, **more)

    monkeypatch.setattr(Tracker, "update", until)
    told = CliRunner().invoke(main, [*words, str(tmp_path / "out")])
    assert told.exit_code == 130 and "Run the same command to continue" in told.output
    assert len(read_motion(tmp_path / "out" / "motion.npz")) == 29
    told = CliRunner().invoke(main, [*words, str(tmp_path / "out")])
    assert told.exit_code == 0 and "continuing the run in" in told.output, told.output
    assert len(count) == 30 + 60 - 28
    assert_same(*(read_motion(tmp_path / name / "motion.npz") for name in ("out", "whole")))
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["motion.npz"]


def test_restart_begins_anew(take, tmp_path, monkeypatch):
    words = ["track", str(take), "--no-overlays", "--no-report", "--formats", "motion", "--out", str(tmp_path / "out")]
    with monkeypatch.context() as patched:
        patched.setattr(one.results, "write_results", lambda *given: 1 / 0)
        assert CliRunner().invoke(main, words).exit_code != 0
    counted = []
    update = Tracker.update

    def counting(self, *given, **more):
        counted.append(1)
        return update(self, *given, **more)

    monkeypatch.setattr(Tracker, "update", counting)
    told = CliRunner().invoke(main, [*words, "--restart"])
    assert told.exit_code == 0 and "continuing" not in told.output
    assert len(counted) == 60
    assert not (tmp_path / "out" / "unfinished").exists()
