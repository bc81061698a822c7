"""What strangers may put into a folder: code that writes down that it ran, and files whose reading has no end."""

import inspect
import os
import signal
import socket
import subprocess
import sys
from importlib import import_module

from kinefit.errors import KinefitError

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
from kinefit.studio.app.jobs import Job
job = Job(Path("take.toml"), ("check", "take.toml"))
asyncio.run(job.run())
assert job.error and "kinefit itself" not in job.error["problem"], job
""",
    "a worker of a batch": """
from kinefit.takes.batch.processes import run_here
assert dict(run_here(len, ["four"], workers=1, retries=0)) == {0: 4}
""",
    "a process of a live session": """
from kinefit._threads import Pool
with Pool(1) as pool:
    assert pool.submit(len, "four").result() == 4
""",
    "pip": """
import subprocess
from kinefit._processes import environment
from kinefit.readers.assets import clients
assert "pip " in subprocess.run([*clients.pip(), "--version"], env=environment(), capture_output=True, text=True).stdout
""",
    "npm": """
import os
from pathlib import Path
from kinefit.readers.assets import clients
os.environ["PATH"] = "." + os.pathsep + os.environ["PATH"]
Path("partial/tmp").mkdir(parents=True)
clients._run([clients.program("npm") or "true", "--version"], Path("partial/tmp"), start=Path("partial/tmp"))
""",
    "a MATLAB file": """
from pathlib import Path
from kinefit.errors import KinefitError
from kinefit.readers.calibration.programs import read_mat
Path("a.mat").write_bytes(b"none")
try:
    read_mat(Path("a.mat"))
except KinefitError as error:
    assert "not a readable" in str(error)
""",
}
"""{road: the words after `python`, or a program for `python -P -c`, which is run in the folder}."""


_PATH = """
import os
os.environ["PYTHONPATH"] = os.pathsep + os.environ.get("PYTHONPATH", "")  # an empty entry is the current folder
"""


def code_that_runs(road, folder):
    """Names of the files of strangers that a road runs in a folder, which is filled with them."""
    ran = folder / "ran"
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"with open({str(ran)!r}, 'a') as file:\n    file.write('{name}.py ')\n")
    for name in PROGRAMS:
        (folder / name).write_text(f"#!/bin/sh\necho {name} >> '{ran}'\n")
        (folder / name).chmod(0o755)
    (folder / "take.toml").write_text("[take]\n")
    words = ROADS[road].split() if ROADS[road].startswith("-m") else ["-P", "-c", _PATH + ROADS[road]]
    done = subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True)
    assert "Traceback" not in done.stderr, done.stderr
    return ran.read_text().split() if ran.exists() else []


ENDINGS = {
    "kinefit.readers.markers:read_markers": ("a.c3d", "a.trc"),
    "kinefit.readers.skeletons.bvh:read_bvh": ("a.bvh",),
    "kinefit.readers.skeletons.acclaim:read_asf": ("a.asf",),
    "kinefit.readers.skeletons.characters:read_gltf": ("a.glb", "a.gltf"),
    "kinefit.readers.skeletons.characters:read_names": ("a.toml", "a.csv"),
    "kinefit.readers.calibration.read:read_calibration": ("a.toml", "a.json", "a.yml", "a.xml", "a.mat", "a.xcp"),
    "kinefit.readers.take.file:read_take": ("take.toml",),
    "kinefit.sensors.kinds.surface_points:read_surface_points": ("a.csv", "a.npz"),
    "kinefit.readers.landmarks.annotations:read_clicks": ("a.json",),
    "kinefit.readers.landmarks.keypoints:read_caliscope_csv": ("a.csv",),
    "kinefit.sensors.kinds.poses:read_body_trackers": ("a.csv",),
    "kinefit.readers.landmarks.annotations:read_static_points": ("a.toml",),
    "kinefit.sensors.kinds.lines:read_lines": ("a.csv", "a.json"),
    "kinefit.readers.landmarks.detections:read_detections": ("a.npz",),
    "kinefit.readers.motion:read_motion": ("a.npz",),
    "kinefit.readers.depth.recordings:read_depth": ("a.mcap", "a.png", "a.tiff", "a.raw", "a.npz", "a.bag"),
    "kinefit.readers.depth.clouds:read_cloud": ("a.ply", "a.pcd"),
    "kinefit.readers.videos.video_files:first_image": ("a.mp4",),
    "kinefit._pictures:read_picture": ("a.png", "a.jpg"),
    "kinefit.bodies:load_body": ("a.toml",),
    "kinefit.bodies.marker_sets.sets:find_record": ("a.toml",),
    "kinefit.bodies.surfaces.mesh:read_obj": ("a.obj",),
    "kinefit.markers.model.model:load_model": ("a.json",),
}
"""{module:function that reads a path: names of files that it reads}."""


def without_end(folder):
    """{kind: function that makes such a file at a path, whose reading waits for ever or never ends}."""
    return {
        "pipe": os.mkfifo,
        "link to a pipe": lambda path: (os.mkfifo(folder / "queue"), path.symlink_to(folder / "queue")),
        "link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "socket": _listen,
    }


def _listen(path):
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.path.relpath(path))


def outcome(reader, path, seconds=5):
    """What a reader makes of a path: the error's text; "hangs", or the kind of an untyped error."""
    module, name = reader.split(":")
    read = getattr(import_module(module), name)

    def wake(*_):
        raise TimeoutError

    asked = [p for p in list(inspect.signature(read).parameters.values())[1:]
             if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]  # fmt: skip
    signal.signal(signal.SIGALRM, wake)
    signal.alarm(seconds)
    try:
        read(path, *(() for _ in asked))
    except KinefitError as error:
        return f"refused: {error}"
    except TimeoutError:
        return "hangs"
    except Exception as error:
        return f"untyped {type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    return "read"
