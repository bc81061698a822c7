"""What a run leaves that is killed, so that the next one goes on where it ended, to the same result bit for bit.

A folder holds what was worked out before the frames, the frames done, and every 300 steps the tracker as it was. What
is written is read back at once and gone on with, so that a run that was stopped goes through the same numbers as one
that was not. Objects are pickled; only classes of kinefit and arrays are unpickled, from a folder of the user's alone,
and only where their checksums hold. A folder of other inputs, settings or another kinefit is emptied.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import FunctionType, MappingProxyType, MethodType, TracebackType
from typing import Any, TypeVar

import numpy as np

from kinefit.errors import ExportError, KinefitError
from kinefit.readers.take.file import Take, read_take

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

T = TypeVar("T")

_NUMPY = {"_reconstruct", "_frombuffer", "scalar", "ndarray", "dtype"}
_BUILT_IN = {"slice", "range", "set", "frozenset", "complex", "bytearray"}
_CHECKSUM = hashlib.sha256().digest_size  # bytes


class Checkpoint:
    """A folder of unfinished work; used as a context, within which no other process works in it.

    Parameters
    ----------
    folder : Path, made where it is not there
    key : of all that the result depends on, see `key_of`
    restart : forget what an earlier run left

    Attributes
    ----------
    resumed : whether an earlier run with the same key left something

    Raises
    ------
    ExportError
        Another process works there, the folder is another user's, or cannot be written.
    """

    def __init__(self, folder: Path, key: str, *, restart: bool = False) -> None:
        self.folder, self._known, self._names = Path(folder), dict[str, Any](), dict[int, str]()
        self._made = not self.folder.parent.exists()
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = open(self.folder / "lock", "w")
            info = self.folder.stat()
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.folder, remedy="Name another place by --out.") from error
        if hasattr(os, "geteuid") and (info.st_uid != os.geteuid() or info.st_mode & 0o022):
            self.close()
            raise ExportError("others can write to this folder", file=self.folder, remedy="Remove it.")
        if fcntl is not None:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                self.close()
                remedy = "Wait until it ends, or name another folder by --out."
                raise ExportError("another run is working there", file=self.folder, remedy=remedy) from error
        name = self.folder / "key"
        self.resumed = not restart and name.is_file() and name.read_bytes() == key.encode()
        if not self.resumed:
            for path in self.folder.iterdir():
                if path.name != "lock":
                    path.unlink()
            name.write_bytes(key.encode())
        for path in self.folder.glob("*.new"):
            path.unlink()
        self.resumed = self.resumed and any(self.folder.glob("*.kept"))

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
        comes_again = isinstance(error, KinefitError) and not isinstance(error, ExportError)
        if comes_again or not any(self.folder.glob("*.kept")):
            self.remove()

    def close(self) -> None:
        """Let others in."""
        self._lock.close()

    def remove(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._made:
            with suppress(OSError):
                self.folder.parent.rmdir()  # of results, if there are none

    def file(self, name: str) -> Path:
        """Place of a file that grows."""
        return self.folder / name

    def know(self, **things: Any) -> None:
        """Objects that every run has of its own, by name: references to them are kept, not they themselves."""
        self._known |= things
        self._names = {id(thing): name for name, thing in self._known.items()}

    def piece(self, name: str, make: Callable[[], T]) -> T:
        """What an earlier run made under this name, or what is made now; as it is read back in both cases."""
        found = self.load(name)
        return self.keep(name, make()) if found is None else found

    def keep(self, name: str, thing: T) -> T:
        """Write something, whole or not at all; returns it as it will be read back.

        Raises
        ------
        ExportError
            It cannot be written.
        """
        buffer = io.BytesIO()
        _Pickler(buffer, self._names).dump(thing)
        data, new = buffer.getvalue(), self.folder / f"{name}.new"
        try:
            with open(new, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(new, self.folder / f"{name}.kept")
        except OSError as error:
            remedy = "Free some space, or name another place by --out."
            raise ExportError(f"cannot be written ({error.strerror})", file=new, remedy=remedy) from error
        return self._read(data)

    def load(self, name: str) -> Any:
        """What was kept under a name; None where there is nothing, or it is damaged."""
        try:
            data = (self.folder / f"{name}.kept").read_bytes()
        except OSError:
            return None
        if hashlib.sha256(data[_CHECKSUM:]).digest() != data[:_CHECKSUM]:
            return None
        return self._read(data[_CHECKSUM:])

    def _read(self, data: bytes) -> Any:
        return _Unpickler(io.BytesIO(data), self._known).load()


def _read_only(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _method(thing: Any, name: str) -> MethodType:
    function = vars(type(thing)).get(name)
    if not isinstance(function, FunctionType):
        raise pickle.UnpicklingError(f"{type(thing).__name__} has no method {name}")
    return MethodType(function, thing)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, names: Mapping[int, str]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._names = names

    def persistent_id(self, thing: Any) -> str | None:
        return self._names.get(id(thing))

    def reducer_override(self, thing: Any) -> Any:
        if isinstance(thing, MappingProxyType):
            return _read_only, (dict(thing),)
        if isinstance(thing, MethodType):
            return _method, (thing.__self__, thing.__func__.__name__)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, Any]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, name: str) -> Any:
        return self._known[name]

    def find_class(self, module: str, name: str) -> Any:
        room = module.partition(".")[0]
        if module == __name__ and name in (_read_only.__name__, _method.__name__):
            return globals()[name]
        if (room == "numpy" and name in _NUMPY) or (module == "builtins" and name in _BUILT_IN):
            return super().find_class(module, name)
        found = super().find_class(module, name) if room == "kinefit" and "." not in name else None
        if not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name} is none of kinefit's classes")
        return found


def key_of(take: Take, **options: Any) -> str:
    """Digest of a take, of its files as far as size and time of change tell, of options and of kinefit's own code."""
    digest = hashlib.sha256(repr((take, sorted(options.items()), np.__version__)).encode())
    digest.update(code_digest())
    takes = [take] if take.subject is None else [take, read_take(take.subject)]
    paths = set().union(*(_paths(one) | {Path(one.body)} for one in takes)) - {take.path}
    for path in sorted(paths, key=str):
        for one in sorted(path.iterdir()) if path.is_dir() else [path]:
            with suppress(OSError):
                info = one.stat()
                digest.update(f"{one} {info.st_size} {info.st_mtime_ns}".encode())
    return digest.hexdigest()


@cache
def code_digest() -> bytes:
    """Of kinefit's own code, as it was when this process first asked."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.digest()


def _paths(thing: Any) -> set[Path]:
    """All paths in a record."""
    if isinstance(thing, Path):
        return {thing}
    if isinstance(thing, str | np.ndarray):
        return set()
    if isinstance(thing, Mapping):
        thing = tuple(thing.values())
    if not isinstance(thing, Sequence):
        names = [*getattr(thing, "__struct_fields__", ()), *getattr(thing, "__dataclass_fields__", ())]
        thing = tuple(getattr(thing, name) for name in names)
    return set().union(*(_paths(one) for one in thing))
