"""A folder of recordings with code that writes down that it ran, and all roads by which kinefit starts a process."""

import os
import subprocess
import sys

NAMES = (
    "ast", "click", "concurrent", "cv2", "json", "kinefit_plugin", "multiprocessing", "numba", "numpy", "pickle", "pip",
    "re", "scipy", "signal", "sitecustomize", "socket", "struct", "tests", "typing", "usercustomize",
)  # fmt: skip
PROGRAMS = ("npm", "node", "pip", "pip3", "python", "nice")

ROADS = {
    "python -m kinefit": "-m kinefit --version",
    "python -m kinefit batch": "-m kinefit batch take.toml",
    "a job of the window": """
import asyncio
from pathlib import Path
from kinefit.app.jobs import Job
job = Job(Path("take.toml"), ("check", "take.toml"))
asyncio.run(job.run())
assert "no [[camera]]" in job.error["problem"] or job.error, job
""",
    "a worker of a batch": """
from kinefit.batch.processes import run_here
assert dict(run_here(len, ["four"], workers=1, retries=0)) == {0: 4}
""",
    "a process of a live session": """
from kinefit._processes import Pool
with Pool(1) as pool:
    assert pool.submit(len, "four").result() == 4
""",
    "pip": """
import subprocess
from kinefit._processes import environment
from kinefit.assets import clients
assert "pip " in subprocess.run([*clients.pip(), "--version"], env=environment(), capture_output=True, text=True).stdout
""",
    "npm": """
import os
from pathlib import Path
from kinefit.assets import clients
os.environ["PATH"] = "." + os.pathsep + os.environ["PATH"]
Path("partial/tmp").mkdir(parents=True)
clients._run([clients.program("npm") or "true", "--version"], Path("partial/tmp"), start=Path("partial/tmp"))
""",
    "a MATLAB file": """
from pathlib import Path
from kinefit.errors import KinefitError
from kinefit.readers.calibration.matlab import read_mat
Path("a.mat").write_bytes(b"none")
try:
    read_mat(Path("a.mat"))
except KinefitError as error:
    assert "not a readable" in str(error)
""",
}
"""{road: the words after `python`, or a program for `python -P -c`, which is run in the folder}."""


def code_that_runs(road, folder):
    """Names of the files of strangers that a road runs in a folder, which is filled with them."""
    ran = folder / "ran"
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"with open({str(ran)!r}, 'a') as file:\n    file.write('{name}.py ')\n")
    for name in PROGRAMS:
        (folder / name).write_text(f"#!/bin/sh\necho {name} >> '{ran}'\n")
        (folder / name).chmod(0o755)
    (folder / "take.toml").write_text("[take]\n")
    words = ROADS[road].split() if ROADS[road].startswith("-m") else ["-P", "-c", ROADS[road]]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["", os.environ.get("PYTHONPATH", "")])}
    if road.startswith("python"):  # with an empty entry it is the user's own wish
        environment["PYTHONPATH"] = os.environ.get("PYTHONPATH", "")
    done = subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True)
    assert "Traceback" not in done.stderr, done.stderr
    return ran.read_text().split() if ran.exists() else []
