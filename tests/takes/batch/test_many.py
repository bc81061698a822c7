"""Many takes: the same however they are split, stopped and resumed; what is wrong with one stays its own."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from kinefit import track_takes
from kinefit.errors import ExportError, FileError
from kinefit.fitting.tracking import run as running
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.takes.batch.one import Choices, TakeJob, work
from kinefit.takes.batch.summary import RECORD

CHOICES = Choices(formats=("motion", "csv"), overlays=False, report=False, smooth=False)
NAMES = ("s01/pre", "s01/post", "s02/pre")


@pytest.fixture(scope="session")
def drawn_sessions(drawn_take, tmp_path_factory):
    """Three short takes of one name, of different frames."""
    root = tmp_path_factory.mktemp("study") / "sessions"
    for k, name in enumerate(NAMES):
        shutil.copytree(drawn_take.parent, root / name, ignore=shutil.ignore_patterns("*.mp4"))
        take = root / name / "take.toml"
        lines = [line for line in take.read_text().splitlines() if not line.startswith("video")]
        text = "\n".join(lines).replace('[[camera]]\n', "[[camera]]\nsize = [544, 960]\n")
        text = text.replace("rate = 30.0", f"rate = 30.0\nframes = [{4 * k}, {4 * k + 8}]")
        text = text.replace('format = "mediapipe"', 'format = "mediapipe"\nrate = 30.0')
        take.write_text(text + f'\n[session]\nsubject = "{name[:3]}"\nvisit = "{name[4:]}"\n')
    return root


@pytest.fixture
def sessions(drawn_sessions, tmp_path):
    shutil.copytree(drawn_sessions, tmp_path / "sessions")
    return tmp_path / "sessions"


def contents(out):
    """{file: bytes} of all results; arrays in place of archives, which hold the time of their writing."""
    found = {}
    for path in sorted(out.rglob("*")):
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found[path.relative_to(out)] = {name: arrays[name].tobytes() for name in arrays.files}
        elif path.is_file() and path.name != RECORD:
            found[path.relative_to(out)] = path.read_bytes()
    return found


@pytest.mark.slow
def test_the_same_with_one_worker_with_two_and_after_a_kill(sessions, tmp_path):
    pattern, seen = f"{sessions}/**/take.toml", []
    rows = track_takes(pattern, tmp_path / "one", choices=CHOICES, progress=lambda *told: seen.append(told[:2]))
    assert [(row.take, row.status, row.frames, row.subject, row.visit) for row in rows] == [
        (f"{name}/take.toml", "done", 8, name[:3], name[4:]) for name in sorted(NAMES)
    ]
    assert seen == [(1, 3), (2, 3), (3, 3)] and all(row.quality > 0.5 and row.ranges for row in rows)
    assert track_takes(pattern, tmp_path / "two", choices=CHOICES, workers=2) == rows
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    words = ["batch", pattern, "--out", str(tmp_path / "killed"), "--no-overlays", "--no-report", "--realtime"]
    words += ["--workers", "2"]
    command = [sys.executable, "-m", "kinefit", *words, "--formats", "motion,csv"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    finished = lambda: {path: path.stat().st_mtime_ns for path in (tmp_path / "killed").rglob(RECORD)}
    while process.poll() is None and not finished():
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed" / "summary.csv").exists()
    time.sleep(1.0)  # its workers end
    done = finished()
    assert subprocess.run(command, stdout=subprocess.DEVNULL).returncode == 0
    assert 0 < len(done) < 3 and finished().items() > done.items()
    assert contents(tmp_path / "killed") == contents(tmp_path / "one")


@pytest.mark.slow
def test_what_is_wrong_with_takes_stands_in_their_rows(sessions, tmp_path):
    corrupt, empty = sessions / "s01" / "pre" / "take.toml", sessions / "s02" / "pre"
    corrupt.write_text(corrupt.read_text().replace("[take]", "[take"))
    for path in empty.glob("*.npy"):  # nobody in it
        np.save(path, np.zeros_like(np.load(path)))
    rows = track_takes(sessions, tmp_path / "out", choices=CHOICES, workers=2)
    assert [row.status for row in rows] == ["done", "failed", "failed"]
    assert "take.toml" in rows[1].error and rows[2].subject == "s02" and rows[2].error
    assert not list((tmp_path / "out" / "s02").rglob("*"))
    text = (tmp_path / "out" / "summary.csv").read_text()
    assert text.count("failed") == 2 and text.count("done") == 1
    shutil.rmtree(sessions / "s01" / "post")
    corrupt.write_text(corrupt.read_text().replace("[take", "[take]"))
    again = track_takes(sessions, tmp_path / "out", choices=CHOICES)
    assert [row.status for row in again] == ["done", "failed"]


def job(take, out, choices=CHOICES):
    return TakeJob(take, "a/take.toml", out, out.name, choices)


def test_done_takes_are_done_again_only_where_something_changed(sessions, tmp_path, monkeypatch):
    take, out = sessions / "s01" / "pre" / "take.toml", tmp_path / "a"
    rows = work(job(take, out))
    assert rows[0].status == "done" and rows[0].folder == "a"
    from kinefit.takes.batch import one as module

    class Again(Exception):
        pass

    def again(*given, **more):
        raise Again

    monkeypatch.setattr(module, "track_person", again)
    assert work(job(take, out)) == rows
    for choices in (Choices(formats=("csv",), overlays=False), Choices(**{**vars(CHOICES), "restart": True})):
        with pytest.raises(Again):
            work(job(take, out, choices))
    (out / "motion.npz").rename(out / "away")
    with pytest.raises(Again):
        work(job(take, out))
    (out / "away").rename(out / "motion.npz")
    os.utime(take.with_name("calibration.toml"), (1, 1))
    with pytest.raises(Again):
        work(job(take, out))
    other = shutil.copytree(take.parent, tmp_path / "other") / "take.toml"
    assert "a has the results of another take" in work(job(other, out))[0].error
    with pytest.raises(Again):
        work(job(other, out, Choices(**{**vars(CHOICES), "restart": True})))
    (out / RECORD).write_text("{")
    with pytest.raises(Again):
        work(job(take, out))


def test_bad_arguments_are_told(sessions, tmp_path):
    for more in ({"workers": 0}, {"retries": -1}):
        with pytest.raises(ExportError):
            track_takes(sessions, tmp_path, **more)
    with pytest.raises(FileError):
        track_takes(Path("nowhere") / "*.toml", tmp_path)


def test_an_old_key_of_a_take_stands_in_its_notes(sessions, tmp_path):
    take = sessions / "s01" / "pre" / "take.toml"
    take.write_text(take.read_text().replace("sigma = 2.0", "accuracy = 2.0", 1))
    (row,) = work(job(take, tmp_path / "a"))
    assert row.status == "done" and "'accuracy' is now called 'sigma'" in row.notes[0]


def test_a_take_that_was_stopped_goes_on_where_it_was(sessions, tmp_path, monkeypatch):
    take = sessions / "s01" / "pre" / "take.toml"
    whole = work(job(take, tmp_path / "a"))
    monkeypatch.setattr(running, "_EVERY", 2)
    update, count = Tracker.update, []

    def until(self, frames, time=None, **more):
        count.append(time)
        if len(count) == 7:
            raise MemoryError("as if it were killed here")
        return update(self, frames, time, **more)

    monkeypatch.setattr(Tracker, "update", until)
    with pytest.raises(MemoryError):
        work(job(take, tmp_path / "b" / "a"))
    assert (tmp_path / "b" / "a" / "unfinished").is_dir() and not (tmp_path / "b" / "a" / RECORD).exists()
    assert work(job(take, tmp_path / "b" / "a")) == whole
    assert len(count) == 7 + 2  # of eight frames the last two
    assert contents(tmp_path / "b" / "a") == contents(tmp_path / "a")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes in folders, and no names but UTF-16")
def test_takes_that_no_reader_can_end_and_names_that_are_not_utf8_are_in_the_summary(sessions, tmp_path):
    pipe, zero, odd = (sessions / name for name in NAMES)
    (pipe / "take.toml").unlink()
    os.mkfifo(pipe / "take.toml")
    (zero / "mediapipe_cam02.npy").unlink()
    (zero / "mediapipe_cam02.npy").symlink_to("/dev/zero")
    odd.rename(odd.with_name(os.fsdecode(b"pr\xe9")))
    out = tmp_path / os.fsdecode(b"out\xff")
    rows = track_takes(sessions, out, choices=CHOICES, workers=1)
    assert {row.take: row.status for row in rows} == {
        "s01/post/take.toml": "failed", "s01/pre/take.toml": "failed", "s02/pr?/take.toml": "done"}  # fmt: skip
    assert all("a pipe, socket or device, not a file" in row.error for row in rows if row.status == "failed")
    text = (out / "summary.csv").read_text("utf-8")
    assert "s02/pr?/take.toml,,s02,pre" in text and "s02/pr?" in (out / "summary.html").read_text("utf-8")
    assert rows[2].frames == 8 and track_takes(sessions, out, choices=CHOICES, workers=1) == rows
