"""Virtual environments of the peers: made once in the user's cache with pinned versions, then found again.

This module runs beside kinefit; the runners run inside the environments.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kinefit._jit import cache_directory

_BASE = ("numpy==2.4.6", "scipy==1.17.1")
_ROOT = Path(__file__).parents[2]
_OWN_PATHS = "PYTHONPATH", "PYTHONHOME", "PYTHONSAFEPATH"  # of this process, not of the peer
_LIMIT_S = 900.0  # [s] for the runner of a peer
_ONE_THREAD = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Peer:
    """One peer: what its environment holds and how its runner is called.

    `bare` packages are installed without their dependencies. `pythons` are the versions it has files for, () for
    kinefit's own.
    """

    environment: str
    packages: tuple[str, ...]
    check: str
    runner: str
    arguments: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()
    pythons: tuple[str, ...] = ()


_MUJOCO = ("mujoco", (*_BASE, "mujoco==4.0.0", "mink==1.3.0", "qpsolvers==4.13.0", "daqp==0.11.0"), "mujoco, mink")
# pymomentum asks for torch (gigabytes), which its geometry and solver2 modules use only where it is there.
_MOMENTUM = ("momentum", _BASE, "pymomentum.solver2", "momentum")
_MOMENTUM_FILES = {"bare": ("pymomentum-cpu==0.1.114.post0",), "pythons": ("3.12", "3.13")}

PEERS: dict[str, Peer] = {
    "pinocchio": Peer("pinocchio", (*_BASE, "pin==4.1.0"), "pinocchio", "pinocchio"),
    "mujoco": Peer(*_MUJOCO, "mujoco_mink", ("mujoco",)),
    "mink": Peer(*_MUJOCO, "mujoco_mink", ("mink",)),
    "opensim": Peer("opensim", (*_BASE, "opensim==4.6"), "opensim", "opensim_ik"),
    "opensim_takes": Peer("opensim", (*_BASE, "opensim==4.6"), "opensim", "opensim_takes"),
    "opensim_sets": Peer("opensim", (*_BASE, "opensim==4.6"), "opensim", "opensim_sets"),
    "opensim_formats": Peer("opensim", (*_BASE, "opensim==4.6"), "opensim", "opensim_formats"),
    "blender_formats": Peer("blender", ("bpy==5.0.1",), "bpy", "blender_formats", pythons=("3.11",)),
    "pyvale": Peer("pyvale", ("pyvale==2026.10.2",), "pyvale.dic", "pyvale_dic"),
    "pyvale_plates": Peer("pyvale", ("pyvale==2026.10.2",), "pyvale.dic", "pyvale_plates"),
    "momentum": Peer(*_MOMENTUM, ("markers",), **_MOMENTUM_FILES),
    "momentum_planes": Peer(*_MOMENTUM, ("planes",), **_MOMENTUM_FILES),
}


def environment(peer: str) -> tuple[Path | None, str]:
    """Python of the peer's environment, made if it is not there yet.

    Returns
    -------
    its python and "", or None and the reason why it cannot be had here.
    """
    record = PEERS[peer]
    folder = cache_directory() / "peers" / record.environment
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pins, stamp = "\n".join((*record.packages, *record.bare)), folder / "kinefit_pins.txt"
    if python.exists() and stamp.exists() and stamp.read_text(encoding="utf-8") == pins:
        return python, ""
    base = next(_interpreters(record.pythons), None)
    if base is None:
        return None, f"needs Python {' or '.join(record.pythons)}, which was not found"
    print(f"making the environment of {peer} in {folder} ...", file=sys.stderr, flush=True)
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary=:all:"]
    steps = [[base, "-m", "venv", "--clear", str(folder)], [*install, *record.packages]]
    if record.bare:
        steps.append([*install, "--no-deps", *record.bare])
    steps.append([str(python), "-c", f"import {record.check}"])
    for step in steps:
        failure = _failure(step, timeout=1800)
        if failure:
            shutil.rmtree(folder, ignore_errors=True)
            return None, f"cannot be installed: {failure}"
    stamp.write_text(pins, encoding="utf-8")
    return python, ""


def run_peer(peer: str, folder: Path) -> dict[str, Any]:
    """Run a peer's runner on an exchange folder, on one core and one thread.

    Returns
    -------
    what the runner printed (see `benchmarks.peers.measure`), or ``{"peer": peer, "reason": why it was not measured}``.
    """
    python, reason = environment(peer)
    if python is None:
        return {"peer": peer, "reason": reason}
    record = PEERS[peer]
    variables = {name: value for name, value in os.environ.items() if name not in _OWN_PATHS}
    command = [str(python), "-m", f"benchmarks.peers.{record.runner}", str(folder.resolve()), *record.arguments]
    found, reason, _ = measured(on_one_core(command), variables, _LIMIT_S)
    return found or {"peer": peer, "reason": reason}


def on_one_core(command: list[str]) -> list[str]:
    """The command held to one core, where the system can do that."""
    taskset = shutil.which("taskset")
    if taskset and hasattr(os, "sched_getaffinity"):
        return [taskset, "-c", str(max(os.sched_getaffinity(0))), *command]
    return command


def measured(
    command: list[str], variables: Mapping[str, str], timeout: float
) -> tuple[dict[str, Any], str, list[str]]:
    """Run a process on one thread from the checkout; it prints what it measured as JSON in its last line.

    Returns
    -------
    what it measured, {} where it printed nothing; why it failed, also where it did so afterwards; its other lines
    """
    try:
        done = subprocess.run(
            command, cwd=_ROOT, env={**variables, **dict.fromkeys(_ONE_THREAD, "1")}, timeout=timeout,
            capture_output=True, text=True,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        late = isinstance(error, subprocess.TimeoutExpired)
        return {}, f"did not finish in {timeout:g} s" if late else str(error), []
    lines = done.stdout.strip().splitlines()
    failed = f"failed: {_last_line(done.stderr) or f'exit code {done.returncode}'}"
    try:
        return json.loads(lines[-1]), failed if done.returncode else "", lines[:-1]
    except (IndexError, ValueError):
        return {}, failed, lines


def _interpreters(versions: tuple[str, ...]) -> Iterator[str]:
    """Pythons of the given versions that run here; the running one if none are given."""
    if not versions or f"{sys.version_info[0]}.{sys.version_info[1]}" in versions:
        yield sys.executable
        return
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    for version in versions:
        found = [shutil.which(f"python{version}"), *sorted(map(str, pyenv.glob(f"{version}.*/bin/python")))]
        for python in filter(None, found):
            check = f"import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '{version}')"
            if not _failure([python, "-c", check], timeout=60):
                yield python


def _failure(command: list[str], timeout: float) -> str:
    """Run a command; "" where it succeeds, else the last thing it said."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return "" if done.returncode == 0 else _last_line(done.stderr) or f"exit code {done.returncode}"


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
