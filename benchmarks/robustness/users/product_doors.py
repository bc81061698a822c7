"""Wrong and unusual inputs through the door, with a user's commands: right, said, or unsaid.

Right: the command gives the result that the user meant. Said: an error, a finding or a note names the cause. Unsaid:
neither, or a warning of Python's own, or an exception that is not kinefit's.
"""

from __future__ import annotations

import re
import shutil
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import kinefit
from benchmarks.commands import QUIET
from benchmarks.commands import answer as command
from benchmarks.figures import amount, data, figure
from benchmarks.robustness.users.faults_users_files import named_files, scene, states, videos, write_depth
from benchmarks.robustness.users.faults_users_pictures import write_video
from kinefit.bodies.motion import Residuals
from kinefit.exporters import write_markers
from kinefit.exporters.report.report import write_report
from kinefit.observations import Markers
from kinefit.takes.batch import corrections

Answer = Callable[[Path], str]
WALK = "markers/momentum/momentum__examples__process_markers_app__02_01.c3d"
KINECT = "depth_skeltrack_kinect1"
FITTED = ("--no-overlays", "--no-report", "--formats", "motion")
_OF_PYTHON = re.compile(r"(Runtime|User|Deprecation)Warning|Traceback|Error in kinefit", re.IGNORECASE)


def run() -> None:
    """Print how many inputs end right, said and unsaid, and each with its state."""
    absent = any(data(name) is None for name in (KINECT, WALK, "cases_of_users"))
    chosen = {} if absent else dict(list(DOORS.items())[: amount(None, 8)])
    counts = Counter(states(chosen, place="session"))
    for state, goal in (("right", ">= 13"), ("said", ">= 17"), ("unsaid", "<= 0")):
        value = None if absent else counts[state]
        figure(f"product_doors_{state}", value, f"of {len(DOORS)}", goal, "no recordings", whole=chosen == DOORS)
    both = None if absent else counts["right"] + counts["said"]
    name = "product_doors_right_or_said"
    figure(name, both, f"of {len(DOORS)}", ">= 30", "no recordings", whole=chosen == DOORS)


def verdict(*words: str, right: bool = False, status: int | None = None, printed: str = "") -> str:
    """Right where it is; said where all words were printed; unsaid else, and after a warning of Python's own."""
    text = printed.lower()
    if _OF_PYTHON.search(printed) or status == 1:
        return "unsaid"
    return "right" if right else "said" if words and all(word.lower() in text for word in words) else "unsaid"


def commands(make: Callable[[Path], object], *lines: tuple[str, ...], words: tuple[str, ...]) -> Answer:
    """Whether every one of some commands says the words; "@" in a word is the folder."""

    def answer(folder: Path) -> str:
        make(folder)
        states = []
        for line in lines:
            status, printed = command(*(word.replace("@", str(folder)) for word in line))
            states.append(verdict(*words, status=status, printed=printed))
        return "unsaid" if "unsaid" in states else "said"

    return answer


# ---- what is no recording


def _nothing(_: Path) -> None:
    """An empty folder."""


def _photograph(folder: Path) -> None:
    cv2.imwrite(str(folder / "me.jpg"), np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8))


def _one_frame(folder: Path) -> None:
    write_video(folder / "a.mp4", range(1))


def _panorama(folder: Path) -> None:
    write_video(folder / "a.mp4", range(20), size=(640, 320))


def _take(name: str = "take.toml", text: str = "", encoding: str = "utf-8") -> Callable[[Path], None]:
    """A take of one video, with lines of [take]."""

    def make(folder: Path) -> None:
        write_video(folder / "a.mp4", range(12))
        (folder / name).write_text(f'[take]\n{text}\n[[camera]]\nname = "a"\nvideo = "a.mp4"\n', encoding=encoding)

    return make


# ---- depth


def _kinect(folder: Path, count: int = 6, name: str = "kinect") -> None:
    """Images of a first Kinect as 16-bit PNG."""
    (folder / name).mkdir()
    root = data(KINECT)
    assert root is not None
    for k, file in enumerate(sorted(root.glob("depth-data-10*"))[:count]):
        cv2.imwrite(str(folder / name / f"{k:04d}.png"), np.fromfile(file, "<u2").reshape(480, 640))


def _written(folder: Path) -> dict[str, object]:
    """First [[depth]] of the take that `init` wrote."""
    return tomllib.loads((folder / "take.toml").read_text())["depth"][0]


def _depth_alone(count: int) -> Answer:
    """Whether `init`, `check` and `track` of depth images alone end, and `track` finds the person."""

    def answer(folder: Path) -> str:
        _kinect(folder, count)
        outputs = [command("init", folder), command("check", folder), command("track", folder, *QUIET)]
        motion = kinefit.read_motion(folder / "take-kinefit") if not outputs[-1][0] else None
        right = motion is not None and len(motion) == count and motion.quality.max() > 0.25
        printed = " ".join(text for _, text in outputs)
        return verdict(right=right and not any(status for status, _ in outputs), printed=printed)

    return answer


def _preset(name: str, size: tuple[int, int], focal: float | None, *words: str) -> Answer:
    """Whether `init` writes the nominal lens of a folder of depth images; without a focal length, says what it asks."""

    def answer(folder: Path) -> str:
        depth = np.rint(1e3 * cv2.resize(scene(1)[0].astype(np.float32), size)).astype(np.uint16)
        (folder / name).mkdir()
        for k in range(3):
            cv2.imwrite(str(folder / name / f"{k:04d}.png"), depth)
        status, printed = command("init", folder)
        found = _written(folder).get("intrinsics")
        right = focal is not None and found == [focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2]
        return verdict(*words, right=right, status=status, printed=printed)

    return answer


def _no_depth(folder: Path) -> None:
    write_depth(folder, np.random.default_rng(0).integers(500, 5000, (3, 120, 160)))


# ---- markers


def gait() -> Markers:
    """A walk of 41 labels."""
    file = data(WALK)
    assert file is not None
    return kinefit.read_markers(file)


def part(markers: Markers, frames: slice, keep: Callable[[str], bool] = lambda name: True) -> Markers:
    """Some frames and labels of a recording."""
    here = [i for i, name in enumerate(markers.names) if keep(name)]
    names = tuple(markers.names[i] for i in here)
    return replace(markers, names=names, positions=markers.positions[frames][:, here], residual=None)


LEGS = ("WT", "KNE", "ANK", "HEE", "TOE", "MT5", "THI", "SHN")


def _is_leg(name: str) -> bool:
    return any(word in name for word in LEGS)


def _markers_alone(folder: Path) -> str:
    """Whether init, check and track agree on markers alone, and angles are those of `markers fit`."""
    write_markers(part(gait(), slice(0, 60)), folder / "walk.trc")
    outputs = [
        command("init", folder), command("check", folder), command("track", folder, *FITTED),
        command("markers", "fit", folder / "walk.trc"),
    ]  # fmt: skip
    printed = " ".join(text for _, text in outputs)
    a, b = (kinefit.read_motion(folder / name) for name in ("take-kinefit", "walk-kinefit"))
    angle = b.body.tree.coordinates.index("knee_angle_r")
    agree = np.degrees(np.abs(a.angles[:, angle] - b.angles[:, angle])).max() < 1.0
    told_all = {"report.html", "tables", "motion.npz"} <= {path.name for path in (folder / "walk-kinefit").iterdir()}
    right = agree and told_all and "needs cameras" not in printed and not any(status for status, _ in outputs)
    return verdict(right=right, printed=printed)


def _empty_ends(folder: Path) -> str:
    """Whether empty frames at both ends are left out, which is said, by both ways to fit markers."""
    x = np.array(gait().positions[:140])
    x[:40] = x[100:] = np.nan
    write_markers(replace(gait(), positions=x, residual=None), folder / "walk.c3d")
    outputs = [command("init", folder), command("track", folder, *FITTED)]
    outputs.append(command("markers", "fit", folder / "walk.c3d"))
    motions = [kinefit.read_motion(folder / name) for name in ("take-kinefit", "walk-kinefit")]
    right = all(len(m) == 60 and abs(m.times[0] - gait().first_time - 40 / m.rate) < 1e-6 for m in motions)
    right = right and all("first 40 and last 40" in text for _, text in outputs[1:])
    return verdict(right=right, printed=" ".join(text for _, text in outputs))


def _legs_alone(folder: Path) -> str:
    """Whether parts without markers are called not observed, and nothing of them is doubtful."""
    write_markers(part(gait(), slice(0, 60), _is_leg), folder / "walk.trc")
    status, printed = command("markers", "fit", folder / "walk.trc")
    page = (folder / "walk-kinefit" / "report.html").read_text()
    right = "doubtful moments: none" in printed and "not observed, as they have no markers: abdomen" in printed
    right = right and "Not observed, as they have no markers: abdomen" in page and 'class="callout bad"' not in page
    return verdict(right=right, status=status, printed=printed)


def _static_trial(folder: Path) -> str:
    """Whether `init` names the static trial in [[markers]], and its lengths are those of `markers fit --static`."""
    write_markers(part(gait(), slice(0, 30)), folder / "static.trc")
    write_markers(part(gait(), slice(30, 90), lambda name: "RMT5" not in name), folder / "walk.trc")
    outputs = [
        command("init", folder), command("track", folder, *FITTED),
        command("markers", "fit", folder / "walk.trc", "--static", folder / "static.trc", "--formats", "motion"),
    ]  # fmt: skip
    bodies = [kinefit.read_motion(folder / name).body for name in ("take-kinefit", "walk-kinefit")]
    lengths = [np.linalg.norm(body.tree.offsets, axis=1) for body in bodies]
    right = 'static = "static.trc"' in (folder / "take.toml").read_text() and np.allclose(*lengths, atol=2e-3)
    return verdict(right=right, printed=" ".join(text for _, text in outputs))


def _without_unit(folder: Path) -> str:
    """Whether a C3D that states no unit is read by its size, or its unit is asked for."""
    file = folder / "walk.c3d"
    write_markers(part(gait(), slice(0, 60)), file)
    raw = file.read_bytes()
    at = raw.index(b"UNITS")
    file.write_bytes(raw[: raw.index(b"mm", at)] + b"  " + raw[raw.index(b"mm", at) + 2 :])
    status, printed = command("markers", "fit", file, "--formats", "motion")
    motion = None if status else kinefit.read_motion(folder / "walk-kinefit")
    right = motion is not None and motion.body.stature is not None and 1.5 < motion.body.stature < 2.1
    return verdict("states no unit", right=right, status=status, printed=printed)


# ---- a stature in centimetres, in each field


def _tall(folder: Path) -> str:
    """Whether `markers fit --height` takes 175, 1,75 and 175 cm as 1.75."""
    write_markers(part(gait(), slice(0, 60)), folder / "walk.trc")
    tall = []
    for k, height in enumerate(("1.75", "175", "1,75", "175 cm")):
        command("markers", "fit", folder / "walk.trc", "--height", height, "--formats", "motion", "-o", folder / str(k))
        tall.append(kinefit.read_motion(folder / str(k)).body.stature)
    return verdict(right=np.ptp(tall) < 1e-9)


def _window_height(folder: Path) -> str:
    """Whether the window's field takes centimetres and a comma."""
    _take()(folder)
    file = folder / "take.toml"
    found = []
    for height in ("1.75", "175", "1,75", "1,75 m"):
        corrections.set_height(file, height)
        found.append(kinefit.read_take(file).height)
    return verdict(right=set(found) == {1.75})


# ---- results


def _result(folder: Path) -> None:
    """A folder of results."""
    (folder / "take-kinefit").mkdir()
    cases = data("cases_of_users")
    assert cases is not None
    shutil.copy(cases / "masks-inverted" / "truth.npz", folder / "take-kinefit" / "motion.npz")


def _export_folder(folder: Path) -> str:
    """Whether a folder of results is exported, and the folder around it names what is wanted."""
    _result(folder)
    status, _ = command("export", folder / "take-kinefit", "--to", "bvh")
    right = status == 0 and (folder / "take-kinefit" / "motion.bvh").is_file()
    other = command("export", folder, "--to", "bvh")[1]
    return verdict(right=right and "take-kinefit" in other)


def _one_camera(folder: Path) -> str:
    """Whether one camera is one sensor in the report, and no box is green while the body is uncertain in all frames."""
    cases = data("cases_of_users")
    assert cases is not None
    motion = kinefit.read_motion(cases / "masks-inverted" / "truth.npz")
    seen = motion.joint_centres[:, :6]
    names, weights, swapped = tuple(motion.body.tree.segments[:6]), np.ones(seen.shape[:2]), np.zeros(len(seen), bool)
    residuals = {
        name: Residuals(names, np.arange(6), 0.0 * seen[..., :n], weights, unit, seen[..., :n], swapped)
        for name, unit, n in (("a", "px", 2), ("lifted a", "m", 3))
    }
    wide = replace(motion, residuals=residuals, joint_std=np.full_like(motion.joint_std, 0.365))
    page = write_report(wide, folder / "report.html").read_text()
    facts = page[page.index("<dt>Sensors</dt>") :][:40]
    right = "<dd>1</dd>" in facts and 'class="callout good"' not in page and "whole body (±" in page
    return verdict(right=right)


DOORS: dict[str, Answer] = {
    "files: an archive": commands(
        named_files("s.zip"), ("track", "@"), ("init", "@"), ("check", "@/s.zip"), words=("unpack",)
    ),
    "files: in the cloud": commands(
        named_files(".IMG_1.MOV.icloud"), ("track", "@"), ("track", "@/.IMG_1.MOV.icloud"), words=("iCloud", "download")
    ),
    "files: a download that is not finished": commands(
        named_files("a.mp4.part"), ("track", "@"), words=("download", "again")
    ),
    "files: an address": commands(
        _nothing, ("track", "https://youtu.be/abc"), ("init", "https://drive.google.com/d/1"),
        ("export", "https://x.org/motion.npz", "--to", "bvh"), words=("address", "download"),
    ),
    "files: two videos for one": commands(
        videos("a.mp4", "b.mp4"), ("track", "@/a.mp4", "@/b.mp4"), ("init", "@/a.mp4", "@/b.mp4"),
        words=("folder of its own",),
    ),
    "files: a video for a take": commands(
        videos("a.mp4"), ("track", "@/a.mp4"), ("check", "@/a.mp4"), words=("a video, not", "init")
    ),
    "files: a video of one frame": commands(_one_frame, ("init", "@"), words=("one frame",)),
    "files: one photograph": commands(_photograph, ("init", "@"), ("track", "@"), words=("images such as me.jpg",)),
    "files: a 360° video of two fisheye images": commands(
        named_files("VID.insv"), ("track", "@"), words=("360", "flat")
    ),
    "files: a 360° video, twice as wide as high": commands(_panorama, ("init", "@"), words=("360", "18:9")),
    "files: an empty folder": commands(_nothing, ("init", "@"), ("track", "@"), words=("no videos", "name a folder")),
    "files: no such folder": commands(_nothing, ("track", "@/nothing"), ("init", "@/nothing"), words=("no such",)),
    "files: a folder without a take": commands(videos("a.mp4"), ("check", "@"), words=("no take file", "init")),
    "take: take.toml.txt": commands(_take("take.toml.txt"), ("check", "@"), words=("rename",)),
    "take: curly quotes": commands(_take(text="name = “walk”"), ("check", "@"), words=("curly",)),
    "take: UTF-16": commands(_take(encoding="utf-16"), ("check", "@"), words=("UTF-8",)),
    "height: 175 in the take": commands(
        _take(text="height = 175"), ("check", "@"), ("track", "@"), words=("metres", "1.75")
    ),
    "height: 1,75 in the take": commands(_take(text="height = 1,75"), ("check", "@"), words=("comma",)),
    "height: 1750 for cameras from people": commands(
        _take(), ("calibrate", "people", "@/take.toml", "--height", "1750"), words=("metres or centimetres",)
    ),
    "height: of markers fit": _tall,
    "height: in the window": _window_height,
    "depth: a folder of one image": _depth_alone(1),
    "depth: alone, of a first Kinect": _depth_alone(4),
    "depth: a RealSense by its name": _preset("D435 session", (848, 480), 425.0),
    "depth: an Orbbec by its name": _preset("astra", (640, 480), 570.0),
    "depth: an Azure Kinect by its size": _preset("depth", (640, 576), 504.0),
    "depth: 640x480 of any camera": _preset("depth", (640, 480), None, "Add the intrinsics", "577 (first Kinect)"),
    "depth: 16-bit images that are none": commands(_no_depth, ("init", "@"), words=("infrared",)),
    "markers: alone": _markers_alone,
    "markers: empty ends": _empty_ends,
    "markers: legs alone": _legs_alone,
    "markers: a static trial": _static_trial,
    "markers: a C3D without a unit": _without_unit,
    "results: export of a folder": _export_folder,
    "results: one camera": _one_camera,
}
"""{what it is: the state of the answer}; each gets an empty folder."""
