"""What the table of a session says of its takes, without tracking them."""

import os

import pytest
from tests.studio.viewers.recordings import RATE, write_take

from kinefit.exporters import write_motion
from kinefit.studio.app import folders
from kinefit.studio.app.folders import measures, recordings

SESSION = '[session]\nsubject = "P01"\ndate = 2026-03-02\nmovement = "squat"\n'


@pytest.fixture
def root(tmp_path):
    """A take with a motion and one without."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_take(tmp_path / name)
    (tmp_path / "b" / "take-kinefit" / "motion.npz").unlink()
    take = tmp_path / "a" / "take.toml"
    take.write_text(take.read_text() + SESSION)
    return tmp_path


def test_each_take_is_a_row_with_its_session_and_measures(root):
    first, second = recordings(root)
    assert first.take.file == root / "a" / "take.toml" and first.folder == root / "a" / "take-kinefit"
    assert first.session == {"subject": "P01", "date": "2026-03-02", "movement": "squat"}
    assert first.seconds == pytest.approx(6 / RATE) and first.agreement == pytest.approx(1.0) and not first.problem
    assert (second.folder, second.seconds, second.agreement, second.person) == (None, None, None, 0)


def test_each_person_is_a_row(root):
    results = root / "a" / "take-kinefit"
    for k in (1, 2):
        (results / f"person-{k}").mkdir()
        (results / f"person-{k}" / "motion.npz").write_bytes((results / "motion.npz").read_bytes())
    found = [row for row in recordings(root) if row.folder]
    assert [(row.person, row.folder.name) for row in found] == [(1, "person-1"), (2, "person-2")]


def test_a_file_is_read_again_only_when_it_changed(root, monkeypatch):
    file = root / "a" / "take-kinefit" / "motion.npz"
    before = measures(file)
    monkeypatch.setattr(folders, "read_npz", lambda *_, **__: pytest.fail("read again"))
    assert measures(file) == before
    monkeypatch.undo()
    from kinefit.readers.motion import read_motion
    from kinefit.simulation import cut

    write_motion(cut(read_motion(file), 0, 3), file)
    os.utime(file, ns=(0, file.stat().st_mtime_ns + 1))
    assert measures(file)[0] == pytest.approx(3 / RATE)


def test_damaged_files_are_rows_too(root):
    (root / "a" / "take.toml").write_text("[take\n")
    (root / "a" / "take-kinefit" / "motion.npz").write_bytes(b"PK nothing")
    first = recordings(root)[0]
    assert "TOML" in first.problem and (first.seconds, first.agreement) == (None, None)
