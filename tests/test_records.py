"""Records are read as they were written; what is damaged, moved or made up is noticed, and nothing of it is run."""

import io
import os
import pickle
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType

import msgspec
import numpy as np
import pytest
from benchmarks.house.house_imports import unpickling_modules
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kinefit._records import Codec, RecordFile
from kinefit.errors import FileError


@dataclass(frozen=True)
class Listed:
    values: np.ndarray
    more: object = None


class Other:
    pass


CODEC = Codec([Listed])
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
THINGS = st.recursive(
    PLAIN | arrays.arrays(st.sampled_from(["f8", "f4", "i4", "u1", "?", "<U3"]), arrays.array_shapes(min_side=0)),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(PLAIN, inner)
    | st.builds(Listed, inner, inner),
)  # fmt: skip


def same(one, other):
    if type(one) is not type(other):
        return False
    if isinstance(one, Listed):
        return same(vars(one), vars(other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(one, dict):
        return same([*one.items()], [*other.items()])
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other or one != one


@given(THINGS)
def test_what_is_read_is_what_was_written(thing):
    assert same(CODEC.decode(CODEC.encode(thing)), thing)


def test_arrays_keep_their_order_in_memory_and_whether_they_may_be_written():
    a = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    b = np.arange(6.0)[::2]
    b.flags.writeable = False
    for array, flags in ((a, (False, True)), (b, (True, False)), (np.array(1.0), (True, True))):
        found = CODEC.decode(CODEC.encode(array))
        assert (found.flags.c_contiguous, found.flags.writeable) == flags
        np.testing.assert_array_equal(found, array)
    for scalar in (np.float32(0.1), np.int64(-3), np.bool_(True)):
        found = CODEC.decode(CODEC.encode(scalar))
        assert found == scalar and type(found) is type(scalar)
    assert CODEC.decode(CODEC.encode(MappingProxyType({1: (2,)}))) == {1: (2,)}


def test_other_objects_are_referred_to_or_refused():
    other, known = Other(), []
    data = CODEC.encode([other], lambda thing: known.append(thing) or 7)
    assert known == [other] and CODEC.decode(data, {7: other}.get) == [other]
    for thing in (other, np.array([other]), {1, 2}, 1j):
        with pytest.raises(TypeError):
            CODEC.encode(thing)
    with pytest.raises(FileError, match="not from kinefit"):
        CODEC.decode(data)


@pytest.mark.parametrize(
    "tree",
    [
        [], [-1], [99, "a", 1], [7, "a"], [3, "|O", [1], False, False, b"12345678"], [4, "|O", b"12345678"],
        [3, "<f8", [10**6], False, False, b"12345678"], [3, "O,f8", [1], False, False, b"1" * 16], [2, [0], 1], [6, 0],
        [5, "text"], ["text"], [[]], [3], [2, 1],
    ],
    ids=str,
)  # fmt: skip
def test_what_no_codec_wrote_is_refused(tree):
    with pytest.raises(FileError, match="not from kinefit"):
        CODEC.decode(msgspec.msgpack.encode(tree))


def test_of_any_bytes_nothing_is_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    rng, whole = np.random.default_rng(0), CODEC.encode([Listed(np.arange(3.0), {"a": (1, None)})])
    for data in (pickle.dumps(Evil()), b"", b"\x91" * 100_000, *(rng.bytes(n) for n in range(1, 300))):
        with suppress(FileError):
            assert isinstance(CODEC.decode(data), int | float | bool | str | bytes | None)
    for k in range(len(whole)):
        with pytest.raises(FileError):
            CODEC.decode(whole[:k])
    assert not (tmp_path / "made").exists()


def test_no_module_unpickles():
    assert unpickling_modules() == []


def written(key=b"key"):
    """A file of three records, where each begins, and its bytes."""
    file = io.BytesIO()
    records = RecordFile(file, key)
    return file, [records.append(data, 1, k) for k, data in enumerate((b"one", b"", b"three"))], records


def test_records_are_found_again_up_to_the_first_that_is_damaged():
    file, places, records = written()
    assert [records.read(at) for at in places] == [b"one", b"", b"three"]
    found = list(RecordFile(file, b"key").scan())
    assert found == [(at, 1, k, data) for k, (at, data) in enumerate(zip(places, (b"one", b"", b"three")))]
    whole = file.getvalue()
    for at in range(len(whole)):
        for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]):
            left = RecordFile(io.BytesIO(damaged), b"key")
            intact = sum(end <= at for end in (*places[1:], len(whole)))
            assert [data for *_, data in left.scan()] == [b"one", b"", b"three"][:intact]
            assert left.end == [0, *places[1:], len(whole)][intact]
    moved = RecordFile(io.BytesIO(whole[places[1] :]), b"key")
    assert not list(moved.scan()) and not list(RecordFile(file, b"another").scan())


def test_a_damaged_record_is_an_error_that_names_its_file():
    file, places, records = written()
    records.name = "frames"
    file.seek(places[2] + 26)
    file.write(b"!")
    with pytest.raises(FileError, match=r"frames: the record at byte \d+ is damaged"):
        records.read(places[2])
