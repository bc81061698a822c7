"""What all tests share: real recordings, a drawn take, and settings of hypothesis."""

import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy, as the command line has it

from kinefit._jit import kernel_folder

ROOT = Path(__file__).resolve().parents[1]

# The first example of a test may compile a kernel, so no deadline; a failure is repeated by anyone who runs the test.
settings.register_profile("kinefit", deadline=None, max_examples=50, derandomize=True)
settings.load_profile("kinefit")


def pytest_configure(config):
    """Compile the common kernels once where the cache has none of this Python, before each worker compiles its own."""
    starts_workers = getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput")
    folder = kernel_folder() if starts_workers else None
    if folder is not None and not any(folder.rglob(f"*.py{sys.version_info[0]}{sys.version_info[1]}.*nbc")):
        print("compiling the kernels, once for all workers ...", flush=True)
        subprocess.run([sys.executable, "-m", "kinefit", "warmup"], check=True, capture_output=True)


def pytest_collection_finish(session):
    """Collect garbage less often: each collection looks through thousands of collected tests."""
    gc.set_threshold(20_000, 20, 20)


_SEARCH_PATHS = "PATH", "PYTHONPATH", "PYTHONSAFEPATH", "NoDefaultCurrentDirectoryInExePath"
_PATHS = {name: os.environ.get(name) for name in _SEARCH_PATHS}  # before any test


def _restore_paths():
    for name, value in _PATHS.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


@pytest.fixture(autouse=True)
def environment_of_each_test():
    """Take back what the command line sets in its process, here the tests' own: by a test or by fixtures before it."""
    _restore_paths()
    yield
    _restore_paths()


@pytest.fixture(scope="session")
def data_dir() -> Callable[[str], Path]:
    """Find a folder of real recordings by name; skip the test where it is absent, fail with KINEFIT_REQUIRE_DATA."""

    def find(name: str) -> Path:
        root = Path(os.environ.get("KINEFIT_DATA") or ROOT.parent / "shared" / "data")
        folder = root / name
        if not folder.is_dir():
            refuse = pytest.fail if os.environ.get("KINEFIT_REQUIRE_DATA") else pytest.skip
            refuse(f"no recording '{name}' in {root}: set KINEFIT_DATA to the folder of recordings")
        return folder

    return find


@pytest.fixture(scope="session")
def drawn_take(tmp_path_factory) -> Path:
    """The take file of a synthetic take of two seconds, drawn once; not to be changed."""
    from kinefit.simulation import write_synthetic_take

    return write_synthetic_take(tmp_path_factory.mktemp("drawn"))


@pytest.fixture(scope="session")
def copy_take(drawn_take) -> Callable[[Path], Path]:
    """Copy the drawn take into a folder; gives its take file, which a test may damage."""

    def copy(folder: Path) -> Path:
        shutil.copytree(drawn_take.parent, folder, dirs_exist_ok=True)
        return folder / "take.toml"

    return copy


@pytest.fixture
def write_frames():
    """Function that writes a video with a frame at each of some steps of a rate [Hz], as grey as its step is late."""
    import av
    import numpy as np

    def write(path, steps, rate=50, size=(640, 480)):
        with av.open(str(path), "w") as container:
            stream = container.add_stream("mpeg4", rate=rate)
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            for step in steps:
                grey = np.full((size[1], size[0], 3), 20 + 5 * step, np.uint8)
                frame = av.VideoFrame.from_ndarray(grey, format="rgb24")
                frame.pts = step
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path

    return write
