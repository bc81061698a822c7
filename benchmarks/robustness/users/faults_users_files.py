"""Files of users: numbers and times in names, folders of cameras, masks, depth, clocks: right, said or unsaid.

Right: the values are those of the recording. Said: an error, a finding or a note names the cause. Unsaid: wrong, and
nobody says so. Each goes through the reader or the command that a user calls, with its defaults. Those cases of
`cases_of_users` that are answered as they have to be, and siblings of all, are tests.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import kinefit
from benchmarks.commands import QUIET
from benchmarks.commands import answer as command
from benchmarks.figures import amount, data, figure, recording
from kinefit.errors import KinefitError
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video
from kinefit.sensors.kinds.silhouettes import read_silhouettes

Answer = Callable[[Path], str]
MAX_JOINT_ERROR = 0.15  # [m] mean over the joints: plain masks of the same takes give 0.11 and 0.13, inverted ones 0.24


def run() -> None:
    """Print how many cases are right and unsaid, and the state of each.

    One that ends in another exception than kinefit's is unsaid, and is shown.
    """
    root, out = recording("cases_of_users"), []
    chosen = dict(list(CASES.items())[: amount(None, 6)])
    for name, answer in chosen.items():
        with tempfile.TemporaryDirectory() as where:
            folder = shutil.copytree(root / name, Path(where) / "case")  # calibrations beside it would be taken, too
            try:
                state = answer(folder)
            except Exception:
                traceback.print_exc(limit=3)
                state = "unsaid"
        print(f"# {state}: {name}", flush=True)
        out.append(state)
    for state, goal in (("right", f">= {len(CASES)}"), ("unsaid", "== 0")):
        told, whole = f"of {len(CASES)}", chosen == CASES
        figure(f"faults_users_files_cases_{state}", out.count(state), told, goal, whole=whole)


def state(is_right: bool, told: str, *words: str) -> str:
    """Right, or said where all words are in what was told."""
    is_said = bool(words) and all(word.lower() in told.lower() for word in words)
    return "right" if is_right else "said" if is_said else "unsaid"


def _tried(read: Callable[[], Any]) -> tuple[Any, str]:
    """What a reader returns, and its error's text."""
    try:
        return read(), ""
    except KinefitError as error:
        return None, str(error)


# ---- masks


def _masks_case(*words: str) -> Answer:
    """Whether a take of masks is tracked with the body where it is, or stops with these words."""

    def answer(folder: Path) -> str:
        status, told = command("track", folder / "take.toml", *QUIET, "--out", folder / "out")
        if status:
            return state(False, told, *words)
        true, found = kinefit.read_motion(folder / "truth.npz"), kinefit.read_motion(folder / "out" / "motion.npz")
        observed = np.isin(np.rint(30 * found.times), np.rint(30 * true.times)) & (found.quality > 0.0)
        rows = np.rint(30 * found.times[observed]).astype(int)
        off = np.linalg.norm(found.joint_centres[observed] - true.joint_centres[rows], axis=-1)
        print(f"# joints {1e3 * off.mean():.0f} mm off in {len(off)} frames", flush=True)
        return state(bool(off.mean() < MAX_JOINT_ERROR), told, *words)

    return answer


def _two_pictures(folder: Path) -> str:
    read = lambda: read_silhouettes(folder / "masks", camera="c", rate=30.0, size=(320, 240))
    return state(False, _tried(read)[1], "two", "one number", "overlay")


# ---- depth


def _depth_case(**given: Any) -> Answer:
    def answer(folder: Path) -> str:
        video = read_depth(folder / "depth", rate=30.0, **given)
        z = video.frame(0).depth
        return state(bool(1.7 < z[z > 0].min() and z.max() < 4.6 and abs(np.median(z[z > 0]) - 3.136) < 0.02), "")

    return answer


def _tum(folder: Path) -> str:
    seen = load_observations(read_take(folder / "take.toml"))
    z, times = seen.depth[0].frame(0).depth, seen.depth[0].times
    right = bool(abs(np.median(z[z > 0]) - 3.1) < 0.2) and np.allclose(np.diff(times), 0.1, atol=1e-3)
    (folder / "take.toml").unlink()
    told = command("init", folder)[1]
    return state(right and "0.0002" in told and "[[depth]]" in (folder / "take.toml").read_text(), told, "0.0002")


# ---- folders


def init(right: Callable[[str], bool], *words: str) -> Answer:
    """Whether the take that `init` writes is right, or it says these words."""

    def answer(folder: Path) -> str:
        told = command("init", folder)[1]
        take = folder / "take.toml"
        return state(take.is_file() and right(take.read_text()), told, *words)

    return answer


def _has(*parts: str, but: tuple[str, ...] = ()) -> Callable[[str], bool]:
    return lambda text: all(part in text for part in parts) and not any(part in text for part in but)


def _shell(folder: Path) -> str:
    files = sorted(map(str, folder.glob("load_*.png")))
    told = command("surface", *files, "--flat", "1", "-o", folder / "out")[1]
    places = [told.find(f"load_{k}.png") for k in (0, 1, 2, 10, 11)]
    return state(min(places) >= 0 and places == sorted(places), told, "load_2.png")


def _windows(folder: Path) -> str:
    status, told = command("check", folder / "as-told.toml")
    return state(status == 0 and "data/m.trc" in command("check", folder / "take.toml")[1], told, "data/m.trc")


def _images(folder: Path) -> str:
    with Video(folder / "frames", rate=30.0) as video:
        return state(np.allclose(video.times, np.arange(20) / 10.0), video.unevenness, "step by 3")


def _lsl(_: Path) -> str:
    """Steps 20 ms apart, half a second of them dropped: time stamps and stated rate, as pylsl has them."""
    import pylsl

    from kinefit.studio.live.receivers.websocket import Lsl

    body, out = kinefit.load_body("humanoid"), Lsl("files", rate=50.0)
    out.hello(body, b"")
    inlet = pylsl.StreamInlet(pylsl.resolve_byprop("name", "files-angles", timeout=5)[0])
    inlet.open_stream(5)
    coordinates, segments = len(body.tree.coordinates), len(body.tree.segments)
    result = SimpleNamespace(
        state=SimpleNamespace(angles=np.zeros(coordinates)), dof_std=np.ones(6 + coordinates),
        joint_std=np.ones((segments, 3)),
    )  # fmt: skip
    poses = np.tile(np.eye(4), (segments, 1, 1))
    zero, sent = pylsl.local_clock(), [k / 50.0 for k in range(60) if not 20 <= k < 45]
    for due in sent:
        time.sleep(max(zero + due - pylsl.local_clock(), 0.0))
        posed: Any = SimpleNamespace(result=result, Ts_world_segment=poses, time=0.0, latency=0.1)
        out.pose(posed, b"")
    stamps = np.array(inlet.pull_chunk(timeout=1.0, max_samples=100)[1])
    out.close()
    even = inlet.info().nominal_srate() != pylsl.IRREGULAR_RATE  # readers then space them evenly
    off = np.abs(stamps - zero + 0.1 - sent) if len(stamps) == len(sent) else np.ones(1)
    return state(not even and float(np.median(off)) < 0.01, "")


def _rokoko(folder: Path) -> str:
    motion = data("cases_of_users") / "masks-inverted" / "truth.npz"  # type: ignore[operator]
    status, told = command("export", motion, "--retarget", folder / "character.glb", "-o", folder / "out.glb")
    return state(status == 0, told)


CASES: dict[str, Answer] = {
    "batch-windows-separators": _windows,
    "character-names-rokoko": _rokoko,
    "depth-npy-files": _depth_case(),
    "depth-raw-float16": _depth_case(size=(128, 96)),
    "depth-tum-unit": _tum,
    "init-depth-track-in-mkv": init(_has("[[depth]]", 'file = "rec.mkv"')),
    "init-folders-own-numbering": init(
        _has("cam1/IMG_0001.MOV", "cam2/IMG_0841.MOV", but=("IMG_0002", "IMG_0842"))
    ),
    "init-gopro-chapters": init(_has("GX010123", but=("GX020123",)), "chapter"),
    "lsl-dropped-frames": _lsl,
    "masks-inverted": _masks_case("inverted"),
    "masks-label-values": _masks_case(),
    "masks-opaque-alpha": _masks_case(),
    "masks-size-of-neither": _masks_case("512x384"),
    "masks-two-pictures-a-number": _two_pictures,
    "numbers-with-gaps-images": _images,
    "numbers-with-gaps-masks": _masks_case("step by 3"),
    "surface-states-by-shell": _shell,
    "video-slow-motion-tag": init(_has("rate = 240"), "240"),
    "video-time-codes": init(_has("time_offset = 0.5")),
}
"""{folder in cases_of_users: the state of the answer to it}."""
