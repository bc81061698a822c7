"""A run that is killed goes on where it ended, to the same motion bit for bit; what it left is trusted with care."""

import os
import pickle

import numpy as np
import pytest
from tests.tracking.movements import BODY, STILL
from tests.tracking.test_long_takes import FIELDS, SUBJECT, recording

from kinefit import track
from kinefit.errors import ExportError, ObservationError
from kinefit.tracking import run as running
from kinefit.tracking.checkpoint import Checkpoint

COUNT, EVERY = 14, 4


class Killed(BaseException):
    """As nothing in kinefit expects."""


@pytest.fixture(autouse=True)
def often(monkeypatch):
    monkeypatch.setattr(running, "_EVERY", EVERY)


def followed(folder, depth, stop=None, key="key", **more):
    """The motion, and the steps that were looked at."""
    looked = []

    def progress(what, done, total):
        if what == "frames":
            looked.append(done)
            if done == stop:
                raise Killed

    with Checkpoint(folder, key) as checkpoint:
        whole = recording(COUNT, depth)
        given = {"settings": STILL, "progress": progress, "checkpoint": checkpoint, **more}
        return track(whole, BODY, subject=SUBJECT, **given), looked


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
    whole, looked = followed(tmp_path / "whole", depth, **options)
    assert looked == list(range(1, COUNT + 1))
    with pytest.raises(Killed):
        followed(tmp_path / "killed", depth, stop=11, **options)
    rows = (tmp_path / "killed" / "so-far.csv").read_text().splitlines()
    assert len(rows) == 1 + 8 and rows[0].startswith("frame,time [s],quality,root_tx [m]") and rows[-1].startswith("7,")
    again, looked = followed(tmp_path / "killed", depth, **options)
    assert looked == list(range(9, COUNT + 1))  # from the last checkpoint
    assert_same(again, whole)
    again, looked = followed(tmp_path / "killed", depth, **options)  # while it was smoothed, say
    assert looked == []
    assert_same(again, whole)


def test_what_is_damaged_or_of_other_inputs_is_begun_anew(tmp_path):
    whole, _ = followed(tmp_path / "whole", False, smooth=False)
    for damage in ("frames.kept", "results.bin", "key"):
        folder = tmp_path / damage
        with pytest.raises(Killed):
            followed(folder, False, stop=11, smooth=False)
        file = folder / damage
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        again, looked = followed(folder, False, smooth=False)
        assert looked[0] == 1
        assert_same(again, whole)
    with pytest.raises(Killed):
        followed(tmp_path / "other", False, stop=11, smooth=False)
    assert followed(tmp_path / "other", False, key="another", smooth=False)[1][0] == 1


def test_only_what_kinefit_writes_is_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    with Checkpoint(tmp_path / "c", "key") as checkpoint:
        with pytest.raises(pickle.UnpicklingError, match="mkdir"):
            checkpoint.keep("evil", Evil())
        assert not (tmp_path / "made").exists()
        told = checkpoint.keep("told", {"a": np.arange(3.0)})
        assert told["a"].tolist() == [0, 1, 2]


def test_nobody_else_works_in_it(tmp_path):
    folder = tmp_path / "c"
    with Checkpoint(folder, "key") as checkpoint:
        checkpoint.keep("something", 1)
        with pytest.raises(ExportError, match="another run is working there"):
            Checkpoint(folder, "key")
        (folder / "half.new").write_bytes(b"of a run that was killed")
    with Checkpoint(folder, "key") as checkpoint:
        assert checkpoint.resumed and checkpoint.load("something") == 1 and not (folder / "half.new").exists()
    with Checkpoint(folder, "key", restart=True) as checkpoint:
        assert not checkpoint.resumed and checkpoint.load("something") is None
    assert not folder.exists()  # nothing to go on from
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(ExportError, match="others can write"):
        Checkpoint(folder, "key")


def test_a_user_s_mistake_leaves_nothing(tmp_path):
    with pytest.raises(ObservationError), Checkpoint(tmp_path / "out" / "c", "key") as checkpoint:
        checkpoint.keep("something", 1)
        raise ObservationError("a mistake")
    assert not (tmp_path / "out").exists()
