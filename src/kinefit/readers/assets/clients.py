"""pip and npm as they are set up here, each to fetch one pinned package, and to check that it is the one expected."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from kinefit._processes import environment, program, python
from kinefit.errors import AssetError
from kinefit.readers.assets.packages import NODE, NODE_SHA256, Package

Progress = Callable[[int, int], None]
"""Called with the bytes fetched so far and the bytes to fetch."""

_REMEDIES = {
    "pip": "Check the network and pip's settings; or copy the wheel here and set PIP_FIND_LINKS to its folder.",
    "npm": "Check the network and npm's settings (npm config get registry).",
}


def download(package: Package, staging: Path, progress: Progress) -> Path:
    """Fetch a package's archive into a folder.

    Raises
    ------
    AssetError
        The client is absent, or cannot reach the package; another package than the one expected.
    """
    staging, start = staging.absolute(), None
    partial = staging / "tmp"
    partial.mkdir()
    if package.index == "npm":
        start = partial  # not the current folder, whose .npmrc and package.json may name programs
        command = [
            *npm(partial), "pack", f"{package.name}@{package.version}", f"--pack-destination={staging}",
            "--loglevel=error", "--ignore-scripts", "--fetch-retries=2", f"--cache={partial / 'cache'}",
        ]  # fmt: skip
    else:
        command = [
            *pip(), "download", "--quiet", "--no-input", "--no-cache-dir", "--disable-pip-version-check", "--retries=2",
            "--no-deps", "--only-binary=:all:", "--python-version=3.12", f"--platform={package.platform}",
            f"--dest={staging}", f"{package.name}=={package.version}",
        ]  # fmt: skip
    messages = _run(command, partial, lambda done: progress(min(done, package.size), package.size), start)
    found = [path for pattern in ("*.whl", "*.tgz") for path in staging.glob(pattern)]
    if messages is not None or len(found) != 1:
        problem = f"{package.index} could not fetch {package}: {_worst(messages or [])}"
        raise AssetError(problem, remedy=_REMEDIES[package.index])
    if (digest := sha256(found[0])) != package.sha256:
        raise AssetError(
            f"the package fetched is not the one expected: its SHA-256 is {digest}, not {package.sha256}",
            place=found[0].name, remedy="Check which package index is set here; nothing of it was kept.",
        )
    progress(package.size, package.size)
    return found[0]


def sha256(path: Path) -> str:
    """Of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def pip() -> list[str]:
    """pip as a command; AssetError where there is none."""
    if importlib.util.find_spec("pip"):
        return python("-m", "pip")
    if found := program("pip3") or program("pip"):
        return [found]
    raise AssetError(
        "pip, which fetches sample data and networks, is not installed", remedy=f"Run: {sys.executable} -m ensurepip"
    )


def npm(partial: Path) -> list[str]:
    """npm as a command; where there is none, one that pip puts into a folder which does not stay; else AssetError."""
    if found := program("npm"):
        return [found]
    folder, wanted = partial / "node", partial / "node.txt"
    wanted.write_text(" ".join([NODE, *(f"--hash=sha256:{digest}" for digest in NODE_SHA256)]), "utf-8")
    options = "--quiet", "--no-input", "--no-deps", "--only-binary=:all:", "--require-hashes"
    messages = _run([*pip(), "install", *options, f"--target={folder}", f"--requirement={wanted}"], partial)
    node = next((path for name in ("node", "node.exe") for path in folder.rglob(name) if path.is_file()), None)
    script = next(folder.rglob("npm-cli.js"), None)
    if messages is not None or node is None or script is None:
        problem = f"npm, which fetches this network, is not installed, and pip could not fetch {NODE}"
        raise AssetError(f"{problem}: {_worst(messages or [])}", remedy="Install Node.js, or check pip's settings.")
    return [str(node), str(script)]


def _run(
    command: Sequence[str], partial: Path, tell: Callable[[int], None] = lambda done: None, start: Path | None = None
) -> list[str] | None:
    """Run a client whose partial downloads lie in a folder; what it said where it failed, else None."""
    done = 0
    temporary = {name: str(partial) for name in ("TMPDIR", "TEMP", "TMP")}
    with (partial.parent / "client.log").open("w+") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=start, env=environment(**temporary))
        try:
            while process.poll() is None:
                done = max(done, _bytes_in(partial))  # the file is moved when all of it is there
                tell(done)
                time.sleep(0.05)
        finally:
            process.kill()  # on Ctrl-C; does nothing once it has ended
            process.wait()
        log.seek(0)
        messages = [line.strip() for line in log if line.strip()]
    return messages if process.returncode else None


def _worst(messages: Sequence[str]) -> str:
    """The line that says most of why a client failed."""
    errors = [m for m in messages if m.startswith(("ERROR", "npm error", "npm ERR!")) and " code " not in m]
    return ([e for e in errors if e.startswith("ERROR")][-1:] or errors[:1] or messages[-1:] or ["no message"])[0]


def _bytes_in(folder: Path) -> int:
    total = 0
    for parent, _, names in os.walk(folder):  # which, unlike rglob, bears that files vanish meanwhile
        for name in names:
            with contextlib.suppress(OSError):
                total += os.path.getsize(os.path.join(parent, name))
    return total
