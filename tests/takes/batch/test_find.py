"""Which takes a pattern means, and where their results go."""

from pathlib import Path

import pytest

from kinefit.errors import FileError
from kinefit.takes.batch.many import find_takes
from kinefit.takes.batch.summary import RECORD

TAKE = '[take]\nname = "walk"\n[[markers]]\nfile = "a.trc"\n'


@pytest.fixture
def sessions(tmp_path):
    for name in ("s01/pre/take.toml", "s01/post/take.toml", "s02/take.toml", "s02/second.toml"):
        (tmp_path / "sessions" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sessions" / name).write_text(TAKE)
    (tmp_path / "sessions" / "s01" / "pre" / "calibration.toml").write_text("[cam]\nsize = [1, 2]\n")
    return tmp_path / "sessions"


def labels(found):
    return [found.label(take) for take in found.takes]


THREE = ["s01/post/take.toml", "s01/pre/take.toml", "s02/take.toml"]


def test_patterns_folders_and_files(sessions, monkeypatch):
    assert labels(find_takes([f"{sessions}/**/take.toml"])) == THREE
    assert labels(find_takes([sessions])) == THREE
    assert labels(find_takes([sessions / "s02"])) == ["take.toml"]
    assert labels(find_takes([f"{sessions}/s0*"])) == ["s02/take.toml"]  # s01 holds none itself
    assert labels(find_takes([f"{sessions}/s01/*", f"{sessions}/s02/take.toml"])) == THREE
    monkeypatch.chdir(sessions.parent)
    assert labels(find_takes(["sessions/**/take.toml"])) == THREE


def test_a_take_named_twice_is_done_once(sessions):
    (sessions / "again").symlink_to(sessions / "s01")
    assert len(find_takes([f"{sessions}/**/take.toml", sessions / "s02" / "take.toml"]).takes) == 3


def test_takes_of_one_name_have_folders_of_their_own(sessions, tmp_path):
    found = find_takes([f"{sessions}/**/*.toml"])
    folders = [found.folder(take, tmp_path / "out") for take in found.takes]
    assert len(found.takes) == 4 == len(set(folders))
    assert tmp_path / "out" / "s01" / "pre" / "take-kinefit" in folders
    assert [path.name for path in found.left_out] == ["calibration.toml"]


def test_a_damaged_take_is_not_left_out(sessions):
    (sessions / "s02" / "broken.toml").write_text("[take\n")
    assert "s02/broken.toml" in labels(find_takes([f"{sessions}/**/*.toml"]))


def test_results_of_a_batch_are_not_found_again(sessions):
    inside = sessions / "results" / "s01" / "take-kinefit"
    inside.mkdir(parents=True)
    (inside / "take.toml").write_text(TAKE)
    assert len(find_takes([sessions]).takes) == 4
    (inside / RECORD).write_text("{}")
    assert labels(find_takes([sessions])) == THREE


@pytest.mark.parametrize(("pattern", "said"), [
    ("nowhere/*.toml", "nothing matches"), ("take.toml", "nothing matches"), ("empty", "nothing matches"),
    ("data/*", "no take file among the 1"), ("", "no take file|nothing matches"),
])  # fmt: skip
def test_what_matches_nothing_is_told(tmp_path, monkeypatch, pattern, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "walk.csv").write_text("1")
    with pytest.raises(FileError, match=said) as told:
        find_takes([pattern])
    assert "sessions/**/take.toml" in str(told.value) and Path(str(told.value.file)) == Path(pattern)
