"""A run that is killed goes on where it ended, to the same motion bit for bit; what it left is trusted with care."""

import os
import pickle
import shutil

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, STILL, a_motion, a_rig
from tests.fitting.tracking.test_contract import SEEN
from tests.fitting.tracking.test_long_takes import FIELDS, SUBJECT, recording
from tests.sensors.fakes import Rope, Seen

from kinefit import Recording, track
from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.fitting.tracking import run as running
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint

COUNT, EVERY = 14, 4


class Killed(BaseException):
    """As nothing in kinefit expects."""


@pytest.fixture(autouse=True)
def often(monkeypatch):
    monkeypatch.setattr(running, "_EVERY", EVERY)


def followed(folder, depth, stop=None, key="key", **more):
    """The motion, the steps that were looked at, and what is said."""
    looked = []

    def progress(what, done, total):
        if what == "frames":
            looked.append(done)
            if done == stop:
                raise Killed

    with Checkpoint(folder, key) as checkpoint:
        whole = recording(COUNT, depth)
        given = {"settings": STILL, "progress": progress, "checkpoint": checkpoint, **more}
        return track(whole, BODY, subject=SUBJECT, **given), looked, " ".join(checkpoint.said())


def assert_same(one, other):
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)
    for name, rest in one.residuals.items():
        np.testing.assert_array_equal(rest.values, other.residuals[name].values)
    assert one.provenance == other.provenance


@pytest.mark.parametrize(
    ("depth", "options"), [(False, {}), (True, {}), (True, {"smooth": False}), (False, {"lag": 0.1})]
)
def test_a_killed_run_goes_on_to_the_same_motion(depth, options, tmp_path):
    whole, looked, said = followed(tmp_path / "whole", depth, **options)
    assert not said and looked == list(range(1, COUNT + 1))
    with pytest.raises(Killed):
        followed(tmp_path / "killed", depth, stop=11, **options)
    rows = (tmp_path / "killed" / "so-far.csv").read_text().splitlines()
    assert len(rows) == 1 + 8 and rows[0].startswith("frame,time [s],quality,root_tx [m]") and rows[-1].startswith("7,")
    again, looked, said = followed(tmp_path / "killed", depth, **options)
    assert looked == list(range(9, COUNT + 1)) and "at frame 8" in said  # from the last checkpoint
    assert_same(again, whole)
    again, looked, _ = followed(tmp_path / "killed", depth, **options)  # while it was smoothed, say
    assert looked == []
    assert_same(again, whole)


def killed(folder, tmp_path):
    """A folder as it was left by a run that was killed after 11 of 14 steps; made once for all tests."""
    made = tmp_path / "made"
    if not made.exists():
        with pytest.raises(Killed):
            followed(made, False, stop=11, smooth=False)
        (made / "lock").unlink()
    shutil.copytree(made, folder)
    return folder / "frames.kinefit"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return tmp_path_factory.mktemp("session")


@pytest.fixture(scope="module")
def whole(session):
    """What a run gives that nothing happens to."""
    return followed(session / "whole", False, smooth=False)[0]


def test_every_flipped_bit_is_noticed_and_computed_again(session, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "_EVERY", EVERY)
    data = killed(tmp_path / "f", session).read_bytes()
    rng, states = np.random.default_rng(0), []
    for k, at in enumerate([*range(0, 90, 12), *rng.integers(0, len(data), 12)]):
        file = killed(tmp_path / f"{k}", session)
        with open(file, "r+b") as opened:
            opened.seek(int(at))
            opened.write(bytes([data[at] ^ (1 << int(rng.integers(8)))]))
        again, looked, said = followed(file.parent, False, smooth=False)
        states.append(looked[0])
        assert str(file.name) in said and "tracked again" in said
        assert_same(again, whole)
    assert set(states) == {1, 5, 9}


def test_a_file_cut_off_anywhere_is_gone_on_with_from_its_last_state(session, whole, tmp_path):
    data = killed(tmp_path / "f", session).read_bytes()
    for k, length in enumerate([0, 1, 30, 82, 83, *np.linspace(84, len(data), 8).astype(int)]):
        file = killed(tmp_path / f"{k}", session)
        os.truncate(file, length)
        again, looked, said = followed(file.parent, False, smooth=False)
        assert bool(said) == bool(length > 82 or length in (1, 30)), (length, said)
        assert ("at frame" in said) == (looked[0] > 1)
        assert_same(again, whole)


def test_another_take_and_another_format_are_computed_anew(session, whole, tmp_path):
    file = killed(tmp_path / "take", session)
    again, looked, said = followed(file.parent, False, key="another", smooth=False)
    assert looked[0] == 1 and "another take" in said and "all frames are tracked again" in said
    assert_same(again, whole)
    file = killed(tmp_path / "format", session)
    file.write_bytes(file.read_bytes().replace(b"frames 3", b"frames 2", 1))
    again, looked, said = followed(file.parent, False, smooth=False)
    assert looked[0] == 1 and "another format" in said
    assert_same(again, whole)


class Evil:
    """Makes a folder where it is unpickled."""

    def __init__(self, made):
        self.made = made

    def __reduce__(self):
        return os.mkdir, (str(self.made),)


@pytest.mark.parametrize("name", ["frames.kinefit", "so-far.csv", "results.bin", "frames.kept", "person.kept", "key"])
def test_nothing_that_lies_in_the_folder_is_run(name, session, whole, tmp_path):
    evil = pickle.dumps(Evil(tmp_path / "made"))
    folder = killed(tmp_path / "f", session).parent
    before = (folder / name).read_bytes() if (folder / name).exists() else b""
    after_head = min(83, len(before))
    for start in (len(before), after_head) if name == "so-far.csv" else (len(before), 0, after_head):
        (folder / name).write_bytes(before[:start] + evil)
        again, _, said = followed(folder, False, smooth=False)
        assert not (tmp_path / "made").exists()
        assert_same(again, whole)
        assert name in said or name == "so-far.csv"


@pytest.mark.parametrize("state", [5, {}, {"tracker": 1}, {"sensors": {"backgrounds": {"x": {}}}}, [], "text"])
def test_a_state_that_somebody_made_up_ends_once(state, whole, tmp_path):
    folder = tmp_path / "c"
    with Checkpoint(folder, "key") as checkpoint:
        checkpoint.frames.keep(4, state)
    with pytest.raises(FileError, match="not one of this tracker"):
        followed(folder, False, smooth=False)
    assert_same(followed(folder, False, smooth=False)[0], whole)


def test_records_of_own_classes_are_refused(tmp_path):
    def tracked(**more):
        with Checkpoint(tmp_path / "c", "key") as checkpoint:
            steps = [[SEEN["left"](i), SEEN["right"](i), Seen("rope", i / RATE, 0.5)] for i in range(10)]
            start = (0, a_motion().state(0))
            given = Recording.of_frames(steps, a_rig(), rate=RATE, sensors=(Rope(),), start=start, up="y")
            track(given, BODY, size=False, settings=STILL, checkpoint=checkpoint)

    with pytest.raises(ObservationError, match="Leave out checkpoint"):
        tracked()


def test_files_of_others_stay(session, tmp_path):
    folder = tmp_path / "c"
    folder.mkdir()
    (folder / "results.bin").write_bytes(b"of somebody else")
    (folder / "lock").write_bytes(b"and this")
    Checkpoint(folder, "key")
    assert sorted(p.name for p in folder.iterdir()) == ["lock", "results.bin"]
    for restart in (False, True):
        with Checkpoint(folder, "key", restart=restart) as checkpoint:
            assert "does not change: results.bin" in " ".join(checkpoint.said())
            checkpoint.frames.keep(1, {})
    checkpoint.remove()
    assert sorted(p.name for p in folder.iterdir()) == ["lock", "results.bin"]
    assert (folder / "lock").read_bytes() == b"and this"
    (folder / "so-far.csv").write_bytes(b"my,own,table")
    with pytest.raises(ExportError, match="so-far.csv: a file of this name is in the way"), Checkpoint(folder, "key"):
        pass
    assert (folder / "so-far.csv").read_bytes() == b"my,own,table"


def test_one_that_is_not_entered_says_how(tmp_path):
    with pytest.raises(ExportError, match="with Checkpoint"):
        track(recording(4, False), BODY, subject=SUBJECT, checkpoint=Checkpoint(tmp_path / "c", "key"))
    assert not (tmp_path / "c").exists()


def test_nobody_else_works_in_it(tmp_path):
    folder = tmp_path / "c"
    with Checkpoint(folder, "key") as checkpoint:
        checkpoint.frames.keep(3, {"a": 1})
        with pytest.raises(ExportError, match="another run uses this folder"), Checkpoint(folder, "key"):
            pass
    with Checkpoint(folder, "key") as checkpoint:
        assert checkpoint.resumed and checkpoint.frames.at == 3 and checkpoint.frames.state == {"a": 1}
    with Checkpoint(folder, "key", restart=True) as checkpoint:
        assert not checkpoint.resumed and checkpoint.frames.state is None
    assert not folder.exists()  # nothing to go on from
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(ExportError, match="other users can write"), Checkpoint(folder, "key"):
        pass


def test_a_user_s_mistake_leaves_nothing(tmp_path):
    with pytest.raises(ObservationError), Checkpoint(tmp_path / "out" / "c", "key") as checkpoint:
        checkpoint.frames.keep(1, 1)
        raise ObservationError("a mistake")
    assert not (tmp_path / "out").exists()
