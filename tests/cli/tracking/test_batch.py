"""`kinefit batch`: what it tells, its exit codes, options that exclude each other."""

import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.takes.batch.summary import FAILED, Row


def run(*words):
    return CliRunner().invoke(main, ["batch", *map(str, words)])


@pytest.fixture
def done(monkeypatch):
    """What the library would be asked; rows as if it had been."""
    asked = {}

    def track_takes(found, out, *, progress, **given):
        asked.update(given, takes=found.takes, out=out)
        rows = (Row(take="a", frames=3, quality=0.5), Row(take="b", person=2, status=FAILED, error="no camera"))
        for k, row in enumerate(rows):
            progress(k + 1, 2, (row,))
        return rows

    monkeypatch.setattr("kinefit.takes.batch.many.track_takes", track_takes)
    return asked


def test_it_passes_on_what_track_takes_and_tells_every_take(done, take, tmp_path):
    words = ("--workers", 2, "--out", tmp_path / "out", "--formats", "csv,bvh", "--no-report", "--lag", 0.1)
    told = run(take.parent, *words, "--pictures", "none", "--retries", 1)
    assert told.exit_code == 2, told.output
    choices = done["choices"]
    assert choices.formats == ("csv", "bvh") and choices.lag == 0.1 and not choices.report and not choices.draws
    assert done["workers"] == 2 and done["retries"] == 1 and done["cluster"] is None and done["takes"] == (take,)
    assert "done   a: 3 frames, quality 0.50" in told.stdout and "failed b, person 2: no camera" in told.stdout
    assert "0 of 1 takes are done" in told.stdout


@pytest.mark.parametrize(("words", "said"), [
    (["--workers", 2, "--cluster", "tcp://x:1"], "give one"), (["--contacts", "--realtime"], "whole take"),
    (["--workers", 0], "workers"), (["--formats", "docx"], "no format 'docx'"),
    (["--lag", 1, "--realtime"], "give one of them"), (["--overlays", "--pictures", "none"], "give one of them"),
])  # fmt: skip
def test_wrong_options_are_told(done, take, words, said):
    told = run(take, *words)
    assert told.exit_code == 2 and said in told.output and not done


def test_a_pattern_that_matches_nothing_is_told(tmp_path):
    told = run(tmp_path / "*" / "take.toml")
    assert told.exit_code == 2 and "nothing matches" in told.output


def test_ctrl_c_names_what_goes_on(take, tmp_path, monkeypatch):
    def stopped(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("kinefit.takes.batch.many.track_takes", stopped)
    told = run(take, "--out", tmp_path / "out")
    assert told.exit_code == 130 and "run the same command to continue" in told.output


def test_files_that_are_no_takes_are_named(done, take):
    told = run(take.parent / "*.toml")
    assert "1 matching TOML files are no takes, and skipped: calibration.toml" in told.output
