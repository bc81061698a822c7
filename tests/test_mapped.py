"""Large arrays in files: the same numbers, before and after their memory was given back."""

import pickle
import tempfile

import numpy as np
import pytest

from kinefit import _mapped
from kinefit._mapped import kept, release, room
from kinefit.observations.arrays import frozen, sealed


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(_mapped, "MIN_MAPPED_BYTES", 1000)


def owner_of(array):
    while isinstance(array, np.ndarray) and array.base is not None:
        array = array.base
    return array


def test_little_stays_where_it_is():
    a = np.ones(5)
    assert kept(a) is a and isinstance(owner_of(room((5,))), np.ndarray)


def test_numbers_stay_when_their_memory_is_given_back(small):
    values = np.random.default_rng(0).random((7, 100, 3))
    out = kept(values)
    assert not isinstance(owner_of(out), np.ndarray)  # it lies in a file
    out[3] = values[3] = 5.0
    release(out[2:], None, values)
    np.testing.assert_array_equal(out, values)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(out)), values)
    assert not room((300, 2)).any()


def test_without_room_on_the_disk_memory_is_taken(small, monkeypatch):
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: (_ for _ in ()).throw(OSError(28, "full")))
    out = room((1000,))
    assert isinstance(owner_of(out), np.ndarray) and not out.any()


def test_what_nobody_can_write_is_not_copied(small):
    for make in (np.ones, room):
        mine = sealed(make((200, 2)))
        assert frozen(mine) is mine
        part = mine[:150]
        assert frozen(part) is part
        assert not np.shares_memory(frozen(mine[:20]), mine)  # which would keep the whole
        assert not np.shares_memory(frozen(mine, np.float32), mine)


def test_what_somebody_could_write_is_copied(tmp_path):
    whole = np.ones(200)
    view = whole[:]
    view.flags.writeable = False
    np.save(tmp_path / "a.npy", whole)
    for given in (whole, view, np.load(tmp_path / "a.npy", mmap_mode="r"), whole.tolist()):
        out = frozen(given)
        assert not np.shares_memory(out, given) and not out.flags.writeable
