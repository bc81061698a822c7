"""Takes and results in the folders of a session."""

from dataclasses import replace

import pytest

from kinefit.errors import FileError
from kinefit.exporters import write_motion
from kinefit.readers.take.file import read_take
from kinefit.simulation import cut, squat_and_wave
from kinefit.studio.app.folders import (
    COMPLETE,
    NEW,
    OUTDATED,
    UNFINISHED,
    TakeFolder,
    openable_files,
    subfolders,
    takes_below,
    video_files,
)
from kinefit.takes.batch import corrections
from kinefit.takes.batch.corrections import inputs_entry


def take_in(folder):
    folder.mkdir(parents=True)
    (folder / "take.toml").write_text('[take]\nname = "x"\n')
    return TakeFolder(folder / "take.toml")


def test_states_of_a_take(tmp_path):
    take = take_in(tmp_path / "a")
    assert take.state == NEW and take.people == ()
    (take.out / "unfinished").mkdir(parents=True)
    assert take.state == UNFINISHED
    (take.out / "unfinished").rmdir()
    (take.out / "motion.npz").write_bytes(b"")
    assert take.state == COMPLETE and take.people == (take.out,)


def test_a_result_is_older_than_its_take_until_the_change_is_taken_back(copy_take, tmp_path):
    take = TakeFolder(copy_take(tmp_path / "a"))
    motion = cut(squat_and_wave(), 0, 3)
    made_from = {"take": "take.toml", **inputs_entry(read_take(take.file))}
    write_motion(replace(motion, provenance=made_from), take.out / "motion.npz")
    assert take.state == COMPLETE
    corrections.trim(take.file, 0, 20)
    assert take.state == OUTDATED
    corrections.undo(take.file)
    assert take.state == COMPLETE
    write_motion(motion, take.out / "motion.npz")  # of an earlier kinefit: nobody knows
    corrections.trim(take.file, 0, 20)
    assert take.state == COMPLETE


def test_people_are_in_the_order_of_their_numbers(tmp_path):
    take = take_in(tmp_path / "a")
    for number in (10, 2, 1):
        (take.out / f"person-{number}").mkdir(parents=True)
        (take.out / f"person-{number}" / "motion.npz").write_bytes(b"")
    assert [folder.name for folder in take.people] == ["person-1", "person-2", "person-10"]
    assert take.state == COMPLETE
    (take.out / "person-2" / "unfinished").mkdir()
    assert take.state == UNFINISHED


def test_takes_below_a_folder_without_results_hidden_and_deep_ones(tmp_path):
    for place in ("monday/a", "monday/b", ".hidden/c", "monday/a/take-kinefit/d", "1/2/3/4/deep"):
        take_in(tmp_path / place)
    found = [take.file.parent.relative_to(tmp_path).as_posix() for take in takes_below(tmp_path)]
    assert found == ["monday/a", "monday/b"]


def test_folders_and_videos_of_a_folder(tmp_path):
    for name in ("B", "a", ".git", "take-detect"):
        (tmp_path / name).mkdir()
    for name in ("1.MP4", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [folder.name for folder in subfolders(tmp_path)] == ["a", "B"]
    assert [video.name for video in video_files(tmp_path)] == ["1.MP4"]
    assert video_files(tmp_path / "gone") == []
    with pytest.raises(FileError, match="cannot be opened.*moved"):
        subfolders(tmp_path / "gone")


def test_what_can_be_opened_is_listed(tmp_path):
    for name in ("b.c3d", "a.MP4", "take.toml", "0001.png", "notes.docx", "walk.trc"):
        (tmp_path / name).touch()
    assert [path.name for path in openable_files(tmp_path)] == ["0001.png", "a.MP4", "b.c3d", "take.toml", "walk.trc"]
    assert [path.name for path in video_files(tmp_path)] == ["a.MP4"] and openable_files(tmp_path / "none") == []
