"""The one compiler setting of all kernels, with a cache that notices every edit.

numba's own cache looks only at the file of the function itself, so an edit in an imported kernel leaves stale machine
code behind. Here the cache directory is keyed by a hash of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_PACKAGE = Path(__file__).parent
# Sums may be reordered. Tests for NaN by x - x or isfinite are compiled away; abs(x) < math.inf works.
_FAST = {"contract", "reassoc", "nsz", "arcp"}


def cache_directory() -> Path:
    """User's cache directory of kinefit: `KINEFIT_CACHE`, else `~/.cache/kinefit`."""
    return Path(os.environ.get("KINEFIT_CACHE") or Path.home() / ".cache" / "kinefit")


def _kernel_hash() -> str:
    digest = hashlib.sha256(numba.__version__.encode() + Path(__file__).read_bytes())
    for source in sorted(_PACKAGE.rglob("_kernels*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


_CACHE = str(cache_directory() / "kernels" / _kernel_hash())


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel (numba, cached, arrays in and arrays out)."""
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, _CACHE
    try:
        return numba.njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = before
