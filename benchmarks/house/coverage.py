"""How much of `src` the tests run: all of them, the slow ones too, in two processes.

Lines that Python runs, those of commands in processes of their own too. What numba compiles is left out, as nobody sees
which of its lines run: the modules of kernels (`_kernels*.py`), of which each has a plain twin in the tests.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.figures import LEFT_OUT, ROOT, NotMeasured, figure, quick


def run() -> None:
    """Print the share, and the files that are run least."""
    if quick() or importlib.util.find_spec("pytest_cov") is None:
        raise NotMeasured(LEFT_OUT if quick() else "pytest-cov is not installed")
    with tempfile.TemporaryDirectory() as folder:
        env = os.environ | {"COVERAGE_FILE": f"{folder}/coverage"}
        tests = ["-n", "2", "--dist", "worksteal", "-m", "slow or not slow", "--cov", "--cov-config=pyproject.toml"]
        told = Path(folder) / "coverage.json"
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *tests, f"--cov-report=json:{told}"], cwd=ROOT, env=env, check=False,
            capture_output=True, text=True,
        )  # fmt: skip
        print(*done.stdout.strip().splitlines()[-1:], flush=True)
        if not told.exists():
            figure("coverage", None, "%", ">= 90", (done.stderr.strip().splitlines() or ["pytest told nothing"])[-1])
            return
        found = json.loads(told.read_text())
    files = {name: one["summary"] for name, one in found["files"].items()}
    for name in sorted(files, key=lambda n: files[n]["percent_covered"])[:10]:
        print(f"# {name}: {files[name]['percent_covered']:.0f} % of {files[name]['num_statements']} statements")
    figure("coverage", found["totals"]["percent_covered"], "%", ">= 90")
