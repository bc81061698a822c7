"""Files of users: numbers and times in names, folders of cameras, masks, depth, clocks: right, said or unsaid.

Right: the values are those of the recording. Said: an error, a finding or a note names the cause. Unsaid: wrong, and
nobody says so. Each case of `cases_of_users` that no other part answers, and siblings, go through the reader or the
command that a user calls, with its defaults.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import kinefit
from benchmarks.commands import QUIET
from benchmarks.commands import answer as command
from benchmarks.figures import amount, data, figure
from benchmarks.robustness.users.faults_users_pictures import write_video
from kinefit.errors import KinefitError
from kinefit.readers.depth.recordings import read_clouds, read_depth
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video
from kinefit.rigs.diagnostics.person import depth_findings
from kinefit.sensors.kinds.silhouettes import read_silhouettes

Answer = Callable[[Path], str]
WERE_RIGHT = 28  # siblings, when they were first measured (2026-11-29): of others, such as archives, the cause is said
SIZE, FOCAL = (160, 120), 144.0
MAX_JOINT_ERROR = 0.15  # [m] mean over the joints: plain masks of the same takes give 0.11 and 0.13, inverted ones 0.24


def run() -> None:
    """Print how many cases and siblings are right, said and unsaid, and the names of those unsaid."""
    root = data("cases_of_users")
    for name, answers, least in (("cases", CASES, len(CASES)), ("siblings", SIBLINGS, WERE_RIGHT)):
        absent = name == "cases" and root is None
        chosen = {} if absent else dict(list(answers.items())[: amount(None, 6)])
        counts, whole = Counter(states(chosen, root if name == "cases" else None)), chosen == answers
        for state, goal in (("right", f">= {least}"), ("unsaid", "== 0")):
            value = None if absent else counts[state]
            told = f"of {len(answers)}"
            figure(f"faults_users_files_{name}_{state}", value, told, goal, "no recordings", whole=whole)


def states(answers: Mapping[str, Answer], root: Path | None = None, place: str = "case") -> list[str]:
    """The state of each answer to a copy of its folder in `root`, or to an empty folder of this name.

    One that ends in another exception than kinefit's is unsaid, and is shown.
    """
    out = []
    for name, answer in answers.items():
        with tempfile.TemporaryDirectory() as where:
            folder = Path(where) / place  # calibrations beside it would be taken, too
            if root is None:
                folder.mkdir()
            else:
                shutil.copytree(root / name, folder)
            try:
                state = answer(folder)
            except Exception:
                traceback.print_exc(limit=3)
                state = "unsaid"
        print(f"# {state}: {name}", flush=True)
        out.append(state)
    return out


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


def body_mask(i: int, size: tuple[int, int] = (64, 48)) -> NDArray:
    """(H, W) uint8, 255 for a body that moves to the right."""
    mask = np.zeros(size[::-1], np.uint8)
    mask[8:40, 10 + i : 24 + i] = 255
    return mask


def masks(
    encode: Callable[[NDArray], NDArray], *words: str, numbers: range = range(5), size: tuple[int, int] = (64, 48)
) -> Answer:
    """Whether masks of the body are read as it is, or refused with these words."""

    def answer(folder: Path) -> str:
        for i in numbers:
            cv2.imwrite(str(folder / f"{i:04d}.png"), encode(body_mask(i, size)))
        video, told = _tried(lambda: read_silhouettes(folder, camera="c", rate=30.0, size=(64, 48)))
        if video is None:
            return state(False, told, *words)
        shown = [video.frame(k).mask > 127 for k in range(len(video))]
        true = [cv2.resize(body_mask(i, size), (64, 48)) > 127 for i in numbers]
        right = all(np.mean(a != b) < 0.03 for a, b in zip(shown, true, strict=True))
        times = np.allclose(video.times, (np.array(numbers) - numbers[0]) / 30.0, atol=1e-6)
        return state(right and times, " ".join(video.notes), *words)

    return answer


def _palette(mask: NDArray) -> NDArray:
    """White background, a red body, as some palettes have it."""
    image = np.full((*mask.shape, 3), 255, np.uint8)
    image[mask > 0] = 40, 20, 200
    return image


def _photograph(mask: NDArray) -> NDArray:
    return np.random.default_rng(0).integers(0, 255, (*mask.shape, 3)).astype(np.uint8)


def _scene_labels(mask: NDArray) -> NDArray:
    """Labels of everything in the image: road, wall, person."""
    labels = np.full(mask.shape, 7, np.uint8)
    labels[: len(mask) // 2] = 11
    return np.where(mask > 0, 24, labels).astype(np.uint8)


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


def _two_numbers(name: str, other: str) -> Answer:
    def answer(folder: Path) -> str:
        for i in range(4):
            cv2.imwrite(str(folder / name.format(i)), body_mask(i))
            cv2.imwrite(str(folder / other.format(i)), body_mask(i))
        told = _tried(lambda: read_silhouettes(folder, camera="c", rate=30.0, size=(64, 48)))[1]
        return state(False, told, "one number")

    return answer


# ---- depth


def scene(frames: int = 12, *, radial: bool = False) -> NDArray:
    """(F, H, W) [m] of a person-sized thing that walks before a wall, over a floor."""
    v, u = np.indices(SIZE[::-1])
    x, y = (u - 79.5) / FOCAL, (v - 59.5) / FOCAL
    z = np.minimum(4.0, np.where(y > 0, 1.2 / np.maximum(y, 1e-6), 9.0))
    out = []
    for k in range(frames):
        body = (np.abs(2.6 * x + 0.8 - 1.6 * k / frames) < 0.25) & (2.6 * y < 1.15) & (2.6 * y > -0.55)
        out.append(np.where(body, 2.6 + 0.05 * x, z) * (np.sqrt(1 + x**2 + y**2) if radial else 1.0))
    return np.array(out)


def write_depth(folder: Path, counts: NDArray) -> Path:
    """Depth images as 16-bit files in folder/depth."""
    (folder / "depth").mkdir()
    for i, image in enumerate(np.rint(counts).astype(np.uint16)):
        cv2.imwrite(str(folder / "depth" / f"{i:04d}.png"), image)
    return folder / "depth"


def depth(write: Callable[[Path], object], *words: str, times: NDArray | None = None, **given: Any) -> Answer:
    """Whether depth is read as the scene's, at its times, or something says these words."""

    def answer(folder: Path) -> str:
        write(folder)
        video, told = _tried(lambda: read_depth(folder / "depth", **given))
        if video is None:
            return state(False, told, *words)
        first = video.frame(0).depth
        on_time = times is None or np.allclose(video.times, times, atol=1e-4)
        return state(bool(np.abs(first - scene(1)[0]).max() < 0.02) and on_time, " ".join(video.notes), *words)

    return answer


def lens(write: Callable[[Path], object], *words: str, centre: float = 79.5) -> Answer:
    """Whether `check` says these words of a depth camera's take."""

    def answer(folder: Path) -> str:
        write(folder)
        keys = f'name = "k"\nfile = "depth"\nrate = 30.0\nintrinsics = [{FOCAL}, {FOCAL}, {centre}, 59.5]\n'
        (folder / "take.toml").write_text(f'[take]\nup = "-y"\n[[depth]]\n{keys}')
        take = read_take(folder / "take.toml")
        seen, told = _tried(lambda: load_observations(take))
        if seen is not None:
            told = " ".join([*map(str, depth_findings(take, seen.depth)), *seen.notes])
        return state(not words and not told, told, *words)

    return answer


def _raw(kind: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "depth").mkdir()
        for i, image in enumerate(scene(3)):
            image.astype(kind).tofile(folder / "depth" / f"{i:04d}.bin")

    return write


def _npy(values: NDArray) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "depth").mkdir()
        for i, image in enumerate(values):
            np.save(folder / "depth" / f"{i:04d}.npy", image)

    return write


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


def _stepped(folder: Path, pattern: str, step: int, start: int = 0) -> Path:
    (folder / "depth").mkdir()
    for i, image in enumerate(np.rint(1e3 * scene(5)).astype(np.uint16)):
        cv2.imwrite(str(folder / "depth" / pattern.format(start + i * step)), image)
    return folder / "depth"


def _clouds(folder: Path) -> str:
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\nDATA ascii\n"
    rows = np.random.default_rng(0).normal((0, 0, 2), 0.2, (40, 3))
    for i in range(0, 15, 3):
        (folder / f"c{i:03d}.pcd").write_text(head + "\n".join(" ".join(f"{v:.4f}" for v in row) for row in rows))
    video = read_clouds(folder, rate=30.0)
    return state(np.allclose(video.times, np.arange(5) / 10.0), " ".join(video.notes), "step by 3")


# ---- folders


def init(make: Callable[[Path], object], right: Callable[[str], bool], *words: str) -> Answer:
    """Whether the take that `init` writes is right, or it says these words."""

    def answer(folder: Path) -> str:
        make(folder)
        told = command("init", folder)[1]
        take = folder / "take.toml"
        return state(take.is_file() and right(take.read_text()), told, *words)

    return answer


def _nothing(_: Path) -> None:
    """The case as it is."""


def _has(*parts: str, but: tuple[str, ...] = ()) -> Callable[[str], bool]:
    return lambda text: all(part in text for part in parts) and not any(part in text for part in but)


def videos(*names: str) -> Callable[[Path], None]:
    """Short videos of these names."""

    def make(folder: Path) -> None:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_video(folder / name, range(12))

    return make


def _tagged(rate: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        import av

        with av.open(str(folder / "v.mp4"), "w", options={"movflags": "use_metadata_tags"}) as container:
            container.metadata["com.android.capture.fps"] = rate
            stream = container.add_stream("mpeg4", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for _ in range(10):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))))
            container.mux(stream.encode())

    return make


def named_files(*names: str) -> Callable[[Path], None]:
    """Files of some names, of which the content is not read."""

    def make(folder: Path) -> None:
        for name in names:
            (folder / name).write_bytes(b"x")

    return make


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
    "init-depth-track-in-mkv": init(_nothing, _has("[[depth]]", 'file = "rec.mkv"')),
    "init-folders-own-numbering": init(
        _nothing, _has("cam1/IMG_0001.MOV", "cam2/IMG_0841.MOV", but=("IMG_0002", "IMG_0842"))
    ),
    "init-gopro-chapters": init(_nothing, _has("GX010123", but=("GX020123",)), "chapter"),
    "lsl-dropped-frames": _lsl,
    "masks-inverted": _masks_case("inverted"),
    "masks-label-values": _masks_case(),
    "masks-opaque-alpha": _masks_case(),
    "masks-size-of-neither": _masks_case("512x384"),
    "masks-two-pictures-a-number": _two_pictures,
    "numbers-with-gaps-images": _images,
    "numbers-with-gaps-masks": _masks_case("step by 3"),
    "surface-states-by-shell": _shell,
    "video-slow-motion-tag": init(_nothing, _has("rate = 240"), "240"),
    "video-time-codes": init(_nothing, _has("time_offset = 0.5")),
}
"""{folder in cases_of_users: the state of the answer to it}."""

MM = 1e3 * scene()
SIBLINGS: dict[str, Answer] = {
    "masks: 0 and 1 to 3, several people": masks(lambda m: (m > 0).astype(np.uint8) * 3),
    "masks: 16 bits, 0 and 24": masks(lambda m: (m > 0).astype(np.uint16) * 24),
    "masks: every fourth frame": masks(lambda m: m, numbers=range(0, 20, 4)),
    "masks: numbers from 100": masks(lambda m: m, numbers=range(100, 105)),
    "masks: black on white in three channels": masks(lambda m: cv2.merge([255 - m] * 3), "inverted"),
    "masks: labels of everything": masks(_scene_labels, "labels"),
    "masks: white palette": masks(_palette),
    "masks: alpha of the body": masks(lambda m: cv2.merge([255 - m] * 3 + [m])),
    "masks: opaque alpha, red body": masks(lambda m: cv2.merge([0 * m, 0 * m, m, 0 * m + 255])),
    "masks: half the size": masks(lambda m: m, size=(32, 24)),
    "masks: another shape": masks(lambda m: m, "not 64x48", size=(48, 48)),
    "masks: photographs": masks(_photograph, "photographs"),
    "masks: compressed edges": masks(lambda m: cv2.GaussianBlur(m, (0, 0), 1.0)),
    "masks: two cameras in a folder": _two_numbers("cam1_{:04d}.png", "cam2_{:04d}.png"),
    "masks: soft masks beside": _two_numbers("{:04d}.png", "{:04d}_soft.png"),
    "depth: every fifth frame": depth(
        lambda f: _stepped(f, "{:06d}.png", 5), "step by 5", times=np.arange(5) / 6.0, rate=30.0
    ),
    "depth: names in nanoseconds": depth(
        lambda f: _stepped(f, "{:d}.png", 50_000_000, 1_403_636_579_763_555_584), times=np.arange(5) / 20.0
    ),
    "depth: names in milliseconds": depth(lambda f: _stepped(f, "d{:05d}.png", 33), times=0.033 * np.arange(5)),
    "depth: names by date": depth(
        lambda f: _stepped(f, "2024-05-01_12-30-05-{:03d}.png", 100), times=np.arange(5) / 10.0
    ),
    "clouds: every third frame": _clouds,
    "depth: 5000 counts a metre, no list": lens(lambda f: write_depth(f, 5 * MM), "0.0002"),
    "depth: 10000 counts a metre": lens(lambda f: write_depth(f, 10 * MM), "0.0001"),
    "depth: three bits for the person": depth(lambda f: write_depth(f, 8 * np.rint(MM) + (MM == MM.min()))),
    "depth: along rays": lens(lambda f: write_depth(f, 1e3 * scene(radial=True)), "along rays"),
    "depth: the colour stream's principal point": lens(lambda f: write_depth(f, MM), "principal point", centre=112.0),
    "depth: no alarm on a right one": lens(lambda f: write_depth(f, MM)),
    "depth: noise of 16 bits": depth(
        lambda f: write_depth(f, np.random.default_rng(0).integers(500, 5000, (3, 120, 160))), "infrared"
    ),
    "depth: raw float16": depth(_raw("<f2"), size=SIZE),
    "depth: raw float32": depth(_raw("<f4"), size=SIZE),
    "depth: numpy files of metres": depth(_npy(scene(3).astype(np.float32))),
    "depth: numpy files of counts": depth(_npy(np.rint(MM[:3]).astype(np.uint16))),
    "init: a folder of 16-bit PNG": init(lambda f: write_depth(f, MM), _has("[[depth]]", 'file = "depth"')),
    "init: a folder of numpy files": init(_npy(scene(3).astype(np.float32)), _has("[[depth]]")),
    "init: one depth image": init(lambda f: write_depth(f, MM[:1]), _has("never"), "one depth image"),
    "init: no calibration, folders of cameras": init(
        videos("a/IMG_0001.mp4", "a/IMG_0002.mp4", "b/IMG_0002.mp4", "b/IMG_0003.mp4"),
        _has("a/IMG_0001.mp4", "b/IMG_0002.mp4", but=("IMG_0003", "a/IMG_0002")),
    ),
    "init: older GoPro chapters": init(
        videos("GOPR0042.mp4", "GP010042.mp4"), _has("GOPR0042", but=("GP010042",)), "chapter"
    ),
    "init: three chapters": init(
        videos("GH010007.mp4", "GH020007.mp4", "GH030007.mp4"), _has("GH010007", but=("GH02", "GH03")), "chapter"
    ),
    "init: 120 Hz in 30": init(_tagged("120"), _has("rate = 120")),
    "init: time lapse": init(_tagged("2.0"), _has("rate = 2.0")),
    "init: a capture rate that is stored": init(_tagged("30.0"), _has("rate = 30")),
    "init: an archive": init(named_files("session.zip"), _has("never"), "archive"),
    "init: in the cloud": init(named_files(".IMG_0001.MOV.icloud"), _has("never"), "iCloud"),
    "init: two fisheye images": init(named_files("VID.insv"), _has("never"), "360"),
}
"""{what it is: the state of the answer}; each gets an empty folder."""
