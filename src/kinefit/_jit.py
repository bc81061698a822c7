"""The one compiler setting of all kernels, with a cache that notices every edit and trusts no one else.

numba's own cache looks only at the file of the function itself, so an edit in an imported kernel leaves stale machine
code behind. Here the cache directory is keyed by a hash of all kernel sources.

Kernels are inlined into the kernels that call them. Otherwise the linker keeps, of all compiled copies of a kernel, the
one it met first: another one in the process that compiles than in one that loads from the cache, or with another order
of calls. As sums may be reordered, copies differ in their last bits, and so would results.

What numba caches is pickled, and unpickling runs code. So a folder that others could have written to is never used, and
files are loaded only if their checksum holds.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import stat
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

_PACKAGE = Path(__file__).parent
# Sums may be reordered. Tests for NaN by x - x or isfinite are compiled away; abs(x) < math.inf works.
_FAST = {"contract", "reassoc", "nsz", "arcp"}
_NOBODY = 65534  # that the system shows as owner of folders outside a container
_CHECKSUM = hashlib.sha256().digest_size  # bytes


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel (numba, cached, arrays in and arrays out)."""
    kernel = numba.njit(nogil=True, fastmath=_FAST, error_model="numpy", forceinline=True)(function)
    folder = kernel_folder()
    if folder is not None and hasattr(kernel, "enable_caching"):  # not with NUMBA_DISABLE_JIT
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
        try:
            kept = _Cache(function)
            if Path(kept.cache_path).is_relative_to(folder):  # numba goes elsewhere if it has to
                kernel._cache = kept
        except (OSError, RuntimeError) as error:
            _tell(f"compiled kernels cannot be kept in {folder} ({error})")
        finally:
            numba.config.CACHE_DIR = before
    return kernel


def cache_directory() -> Path:
    """User's cache directory of kinefit: `KINEFIT_CACHE`, else `~/.cache/kinefit`, without a home a temporary one."""
    if os.environ.get("KINEFIT_CACHE"):
        return Path(os.environ["KINEFIT_CACHE"])
    try:
        return Path.home() / ".cache" / "kinefit"
    except RuntimeError:
        return _temporary()


@cache
def kernel_folder() -> Path | None:
    """Folder of the compiled kernels, readable by the user alone; None where there is no safe one.

    Where `cache_directory` cannot be used, a warning says why, once, and a temporary folder takes its place.
    """
    problems = []
    for place in (cache_directory, _temporary):
        try:
            folder = (place() / "kernels" / _kernel_hash()).resolve()
            _make_private(folder)
        except (OSError, RuntimeError) as error:
            problems.append(str(error))
            continue
        if problems:
            _tell(f"compiled kernels are kept in {folder}, as the cache cannot be used: {problems[0]}")
        return folder
    _tell(f"kernels are compiled at every start, as the cache cannot be used: {problems[0]}")
    return None


def _kernel_hash() -> str:
    digest = hashlib.sha256(numba.__version__.encode() + Path(__file__).read_bytes())
    for source in sorted(_PACKAGE.rglob("_kernels*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _user() -> int:
    return os.geteuid() if hasattr(os, "geteuid") else -1


def _temporary() -> Path:
    return Path(tempfile.gettempdir()) / f"kinefit-{_user()}"


def _make_private(folder: Path) -> None:
    """Make a folder for the user alone; OSError where that cannot be, or where others could have written to it."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    _refuse_strangers(folder.parents[max(len(missing) - 1, 0)])
    for path in reversed(missing):
        path.mkdir(mode=0o700, exist_ok=True)
    _refuse_strangers(folder)
    if _user() >= 0 and folder.stat().st_uid != _user():
        raise OSError(f"{folder} belongs to another user")
    if _user() >= 0 and folder.stat().st_mode & 0o077:
        raise OSError(f"{folder} is open to others: remove it")
    tempfile.TemporaryFile(dir=folder).close()


def _refuse_strangers(folder: Path) -> None:
    """Raise OSError where a folder or one above it is another user's, or others may put their own in its place."""
    if _user() < 0:
        return  # Windows: a user's folders are the user's
    for path in (folder, *folder.parents):
        info = path.stat()
        if info.st_uid not in (_user(), 0, _NOBODY):
            raise OSError(f"{path} belongs to another user")
        shared = info.st_mode & stat.S_IWOTH or (info.st_mode & stat.S_IWGRP and not _of_one(info.st_gid))
        if shared and not info.st_mode & stat.S_ISVTX:
            raise OSError(f"others may write to {path}")


def _of_one(group: int) -> bool:
    """Whether a group has the user, or the superuser, as its only member, as many systems give to everyone."""
    import grp
    import pwd

    try:
        user, members = pwd.getpwuid(_user()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return group == 0 or (members.gr_name == user and set(members.gr_mem) <= {user})


@cache
def _told() -> list[str]:
    """Notes that were printed, one list for the process."""
    return []


def _tell(problem: str) -> None:
    """Warn once for a process, whatever else goes wrong with the cache."""
    if not _told():
        _told().append(problem)
        warnings.warn(f"{problem}. KINEFIT_CACHE names another folder.", RuntimeWarning, stacklevel=2)


class _Files(caching.IndexDataCacheFile):
    """Files that are read only if their checksum holds; damaged ones are as if absent and are written anew."""

    def _dump(self, obj: Any) -> bytes:
        data = super()._dump(obj)
        return hashlib.sha256(data).digest() + data

    def _load_index(self) -> dict[Any, str]:
        head = pickle.dumps(self._version, protocol=-1)
        try:
            stamp, overloads = _unpickled(Path(self._index_path).read_bytes().removeprefix(head))
        except OSError:
            return {}
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        return _unpickled(Path(self._data_path(name)).read_bytes())


def _unpickled(data: bytes) -> Any:
    if hashlib.sha256(data[_CHECKSUM:]).digest() != data[:_CHECKSUM]:
        raise OSError("damaged file")
    return pickle.loads(data[_CHECKSUM:])


class _Cache(caching.FunctionCache):
    """numba's cache of one kernel, for which a kernel that cannot be loaded or kept is no reason to stop."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:
            _tell(f"a compiled kernel in {self._cache_path} cannot be loaded ({error})")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _tell(f"compiled kernels cannot be kept in {self._cache_path} ({error})")
