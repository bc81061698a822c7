"""One reader on damaged copies of its seed, a line a file.

`python -m benchmarks.robustness.fuzz.fuzz_worker READER FIRST COUNT` runs it.

Lines: `at I` before a file is read, then `I KIND SECONDS MEGABYTES TEXT`; the process that started it stops what takes
too long, and counts a process that ends amid a file as a crash. It ends before COUNT files where its memory has grown.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from pathlib import Path

import av

from benchmarks.robustness.fuzz.fuzz_mutations import mutated
from benchmarks.robustness.fuzz.fuzz_readers import seed_of
from benchmarks.robustness.fuzz.fuzz_seeds import Seed

_KEPT = 200  # [MB]
LONGEST = 600
"""Characters that a message may have."""


def main(name: str, first: int, count: int, memory: int) -> None:
    """Read `count` damaged copies; `memory` [MB] is what each may take beyond what the process has."""
    faulthandler.enable()
    out = os.fdopen(os.dup(1), "w", encoding="utf-8", errors="replace")
    os.dup2(2, 1)  # what libraries print is not among the lines
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as place:
        seed = seed_of(name, Path(place))
        seed.read()  # as it is; imports and kernels are there from here on
        whole = [file.read_bytes() for file in seed.files]
        size, most = _status("VmSize"), resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (size + (memory + _KEPT) * 10**6, most))
        for i in range(first, first + count):
            if i > first and _status("VmSize") > size + _KEPT * 10**6:  # what libraries keep of the files before
                break
            which = i % len(whole)
            try:
                seed.files[which].write_bytes(mutated(whole[which], [zlib.crc32(name.encode()), i]))
                print(f"at {i}", file=out, flush=True)
                print(i, *_read(seed, Path(place)), file=out, flush=True)
            finally:
                seed.files[which].write_bytes(whole[which])


def _read(seed: Seed, place: Path) -> tuple[str, str, str, str]:
    """Kind, time of the processor [s], memory [MB] and what was said."""
    kind, *told = answer(seed, place)
    if kind == "claim":
        limits = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (limits[1], limits[1]))
        kind, *told = answer(seed, place)
        resource.setrlimit(resource.RLIMIT_AS, limits)
    return ("typed" if kind == "claim" else kind), *told  # type: ignore[return-value]


def answer(seed: Seed, place: Path) -> tuple[str, str, str, str]:
    """Kind, time of the processor [s], memory [MB] beyond what the process has, and what was said.

    The kind is "claim" where FFmpeg says that memory is lacking, as it does of counts that cannot be.
    """
    from kinefit.errors import KinefitError

    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before, began = _status("VmRSS"), time.process_time()
    try:
        seed.read()
        kind, text = "read", ""
    except KinefitError as error:
        kind, text = _kind(error, place), repr(str(error))
    except MemoryError:
        kind, text = "memory", _last()
    except Exception as error:
        text = repr(f"{type(error).__name__}: {error} @ {_last()}")
        kind = "memory" if "Insufficient memory" in text else "untyped"
    peak = (_status("VmHWM") - before) / 1e6
    return kind, f"{time.process_time() - began:.3f}", f"{peak:.0f}", text[:1500]


def _kind(error: BaseException, place: Path) -> str:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "claim" if isinstance(cause, av.FFmpegError) else "memory"
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return "long" if len(str(error).replace(str(place), "")) > LONGEST else "typed"


def _last() -> str:
    """Where the error arose, of kinefit's own lines."""
    frames = traceback.extract_tb(sys.exc_info()[2])
    own = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "kinefit" in f.filename]
    return " ".join(own[-2:])


def _status(key: str) -> int:
    """[bytes] of this process, as Linux counts them."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key + ":"))
    return int(line.split()[1]) * 1024


if __name__ == "__main__":
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    main(sys.argv[1], *map(int, sys.argv[2:5]))
