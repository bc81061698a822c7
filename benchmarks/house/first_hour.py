"""README's two commands in a clone on a machine that never saw kinefit, and the tests of a change there.

Their clocks tell of the machine and the package index, too: other work on its cores, and a slow index, count.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.figures import LEFT_OUT, ROOT, NotMeasured, data, figure, quick

_FORGOTTEN = ("KINEFIT_CACHE", "NUMBA_CACHE_DIR", "PYTHONPATH", "VIRTUAL_ENV", "PYTHONDONTWRITEBYTECODE")
_LIMIT_S = 3600


def run() -> None:
    """Print the time of each command.

    Raises
    ------
    NotMeasured
        In the quick form.
    """
    if quick():
        raise NotMeasured(LEFT_OUT)
    with tempfile.TemporaryDirectory() as folder:
        environment = _new_home(Path(folder) / "home")
        demo, tests = Path(folder) / "demo", Path(folder) / "tests"
        for clone in (demo, tests):
            subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        _time("first_hour_demo", 1.0, "s", "<= 90", demo, readme_command("demo"), environment)
        _time("first_hour_tests", 60.0, "min", "<= 10", tests, readme_command("test"), environment)
        (tests / "src" / "kinefit" / "errors.py").open("a").write("\n")
        changed = "s with packages and kernels there"
        _time("first_hour_changed", 1.0, changed, "<= 180", tests, ".ci/changed", environment)


def readme_command(kind: str) -> str:
    """The command that the README gives as that of the demo or the test."""
    found = re.search(rf"<!-- {kind} command -->\n```bash\n(.+?)\n```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert found is not None
    return found[1]


def _time(name: str, unit_s: float, unit: str, goal: str, folder: Path, command: str, environment: dict) -> None:
    began = time.monotonic()
    words = ["bash", "-euo", "pipefail", "-c", command]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S)
    spent = (time.monotonic() - began) / unit_s
    lines = (done.stdout + done.stderr).strip().splitlines()
    print(f"# {command}: exit code {done.returncode}", *lines[-20 if done.returncode else -1 :], sep="\n# ", flush=True)
    figure(name, spent if done.returncode == 0 else None, unit, goal, f"it ended with code {done.returncode}")


def _new_home(home: Path) -> dict[str, str]:
    """The environment with an empty home, no caches, and the recordings where they are."""
    home.mkdir(mode=0o700)
    places = {"HOME": home, "XDG_CACHE_HOME": home / ".cache", "XDG_CONFIG_HOME": home / ".config"}
    kept = {key: value for key, value in os.environ.items() if key not in _FORGOTTEN}
    kept.setdefault("PYENV_ROOT", str(Path.home() / ".pyenv"))  # python3 may be a shim that looks for itself in HOME
    if (recordings := data(".")) is not None:
        kept["KINEFIT_DATA"] = str(recordings)
    return {**kept, **{key: str(path) for key, path in places.items()}}
