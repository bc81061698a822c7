"""One person before a real depth camera, by the command's road: hands and elbows against what was read by hand.

Pixels below were read from the images, to about 5 px: middle of the hand, between the wrist (where the forearm no
longer narrows) and the knuckles (2 cm nearer than where stretched fingers part, 1 cm from a fist's end), and the lower
end of a raised forearm. A hand lies 1.5 cm behind the surface that is seen there, an elbow 4 cm. A fist that points to
the camera (the forearm is seen beside it, 10 to 30 cm farther off, or hidden by it) shows its knuckles: the middle of
the hand lies half of the 9 cm from there to the wrist behind them, and 1 cm of flesh. Nothing was fitted to them. Two
people are in the first and the last image of the Kinect: the nearer counts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, each, figure, recording
from benchmarks.scenes.takes import tracked
from benchmarks.timing import took
from kinefit import Motion
from kinefit.bodies.motion import BELIEVED
from kinefit.readers.take.load import Observations

Read = dict[str, tuple[int, int]]  # part of the body: pixel
KINECT: dict[str, Read] = {  # in the order of the files' numbers
    "82823944": {"hand_r": (89, 260), "hand_l": (424, 258)},
    "1028894671": {"fist_r": (110, 367), "fist_l": (505, 331)},
    "1038901490": {"hand_r": (101, 415), "hand_l": (518, 109)},
    "1045879925": {"hand_r": (97, 128), "hand_l": (516, 101)},
    "1051883281": {"hand_r": (70, 49), "hand_l": (543, 53)},
    "1058893191": {"hand_r": (123, 216), "hand_l": (494, 192)},
    "1064898470": {"hand_r": (96, 411), "hand_l": (512, 383)},
    "1070905432": {"hand_r": (42, 65), "fist_l": (440, 327)},
    "1078881076": {"fist_r": (151, 327), "fist_l": (461, 301)},
    "1166565565": {"fist_r": (121, 386), "hand_l": (479, 54)},
    "1234568668": {"fist_r": (84, 282), "hand_l": (490, 111)},
    "1399145206": {"hand_l": (471, 213)},
}
SR305: dict[str, dict[str, Read]] = {
    "20210326-230536": {
        "30": {"hand_r": (306, 324), "elbow_r": (402, 285)}, "50": {"hand_r": (307, 289), "elbow_r": (430, 283)},
        "70": {"hand_r": (312, 288), "elbow_r": (408, 322)}, "90": {"hand_r": (303, 256)},
        "110": {"hand_r": (260, 239), "elbow_r": (150, 235)}, "130": {"hand_r": (254, 202), "elbow_r": (110, 75)},
        "150": {"hand_r": (303, 212)}, "170": {"hand_r": (289, 228)},
    },
    "20210326-231615": {
        "0": {"hand_r": (265, 313)}, "20": {"hand_r": (338, 302), "elbow_r": (322, 435)},
        "40": {"hand_r": (324, 323), "elbow_r": (328, 447)}, "60": {"hand_r": (328, 315), "elbow_r": (328, 445)},
        "80": {"hand_r": (328, 316), "elbow_r": (333, 448)}, "100": {"hand_r": (333, 312), "elbow_r": (335, 450)},
        "140": {"hand_r": (325, 308), "elbow_r": (333, 452)}, "160": {"hand_r": (333, 310), "elbow_r": (338, 455)},
        "180": {"hand_r": (341, 300), "elbow_r": (335, 455)}, "200": {"hand_r": (338, 297), "elbow_r": (336, 458)},
        "220": {"hand_r": (348, 301)},
    },
}  # fmt: skip
BEHIND = {"hand": 0.015, "fist": 0.055, "elbow": 0.04}  # [m] of the part's middle behind its surface
SEGMENTS = {"hand": "hand", "fist": "hand", "elbow": "forearm"}
_GOALS = {
    "people_kinect_images": ("images with the person found", "== 12"),
    "people_kinect_right": ("hands of 23 within 6 cm, lost or not", ">= 21"),
    "people_kinect_right_lost": ("of these are said to be lost", "<= 2"),
    "people_kinect_said": ("hands of 23 farther off than 6 cm that are said to be lost", "<= 2"),
    "people_kinect_unsaid": ("hands of 23 farther off than 6 cm and not said to be lost", "<= 2"),
    "people_kinect_seconds": ("s CPU an image, two people in two of twelve", "<= 4"),
    "people_sr305_right": ("hands and elbows of 33 within 4 cm, lost or not", ">= 17"),
    "people_sr305_right_lost": ("of these are said to be lost", "<= 2"),
    "people_sr305_said": ("hands and elbows of 33 farther off than 4 cm that are said to be lost", "<= 16"),
    "people_sr305_unsaid": ("hands and elbows of 33 farther off than 4 cm and not said to be lost", "<= 2"),
    "people_sr305_seconds": ("s CPU an image, the slower recording", "<= 4"),
}  # fmt: skip
_TAKE = """[take]
rate = {rate}
up = "-y"
frames = [0, {frames}]
[[depth]]
name = "depth"
file = "{folder}"
rate = {rate}
unit = {unit}
intrinsics = {lens}
range = {range}
{more}"""


def run() -> None:
    """Print every figure."""
    each(_kinect, _sr305)


def _kinect() -> None:
    folder = recording("depth_skeltrack_kinect1")
    names = list(KINECT)[amount(slice(None), slice(1, 2))]  # in the first image are two people
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            (Path(work) / f"depth-data-{name}").symlink_to(folder / f"depth-data-{name}")
        text = _TAKE.format(rate=1.0, frames=len(names), folder=work, unit=0.001, lens=[575.0, 575.0, 319.5, 239.5],
                            range=[0.5, 5.0], more="size = [640, 480]\n")  # fmt: skip
        (motion, seen), spent = took(partial(tracked, text))
        gaps = _gaps(motion, seen, dict(enumerate(KINECT[name] for name in names)))
    figure("people_kinect_images", float(np.sum(motion.quality > 0.0)), *_GOALS["people_kinect_images"])
    _figures("people_kinect", list(gaps.values()), 0.06, spent / len(names))
    _tell(gaps, names, 0.06)


def _sr305() -> None:
    folder = recording("depth_sr305_upperbody")
    every, spent = [], []
    for take, images in list(SR305.items())[: amount(None, 1)]:
        count = amount(len(images), 1)
        text = _TAKE.format(rate=1.5, frames=count, folder=folder / take, unit=0.000125, range=[0.2, 2.0], more="",
                            lens=[476.007, 476.007, 313.683, 242.755])  # fmt: skip
        (motion, seen), seconds = took(partial(tracked, text))
        spent.append(seconds / count)
        gaps = _gaps(motion, seen, dict(enumerate(list(images.values())[:count])))
        print(f"# {take}")
        _tell(gaps, list(images), 0.04)
        every += list(gaps.values())
    _figures("people_sr305", every, 0.04, max(spent))


def _figures(area: str, gaps: list[tuple[float, bool]], limit: float, spent: float) -> None:
    """Right, said and unsaid apart, of what is so far off [m] and said to be lost or not; seconds an image."""
    right, lost = np.array([gap <= limit for gap, _ in gaps]), np.array([gone for _, gone in gaps])
    counts = {"right": right, "right_lost": right & lost, "said": ~right & lost, "unsaid": ~right & ~lost}
    for name, value in {**{name: float(np.sum(of)) for name, of in counts.items()}, "seconds": spent}.items():
        figure(f"{area}_{name}", value, *_GOALS[f"{area}_{name}"])
    print(f"# {area}: {100 * float(np.mean(right | lost)):.0f} % right or said to be lost")


def _gaps(motion: Motion, seen: Observations, read: Mapping[int, Read]) -> dict[tuple[int, str], tuple[float, bool]]:
    """(image, part): distance [m] of the fitted part from what was read, and whether it is said to be lost."""
    names, out = motion.body.landmarks.names, {}
    x, segments = motion.positions(), motion.body.tree.segments
    at = lambda name, i: x[i, names.index(name)]
    for i, parts in read.items():
        for part, pixel in parts.items():
            kind, _, side = part.partition("_")
            true = _point(seen, i, pixel, BEHIND[kind])
            if kind == "elbow":
                found = at(f"{side}_elbow", i)
            else:
                found = (at(f"{side}_wrist", i) + at(f"{side}_metacarpal_phalanx_3", i)) / 2.0
            segment = segments.index(f"{SEGMENTS[kind]}_{side}")
            lost = bool(motion.segment_quality[i, segment] < BELIEVED)
            out[i, part] = float(np.linalg.norm(found - true)), lost
    return out


def _point(seen: Observations, i: int, pixel: tuple[int, int], behind: float) -> NDArray:
    """(3,) [m] so far behind the surface that is measured about a pixel."""
    frame, (u, v) = seen.depth[0].frame(i), pixel
    assert seen.rig is not None
    camera = seen.rig[frame.sensor]
    about = frame.depth[max(v - 6, 0) : v + 7, max(u - 6, 0) : u + 7]
    z = float(np.median(about[about > 0])) + behind
    x = z * np.append(camera.ray_table[:, v, u], 1.0)
    return np.asarray(x @ camera.T_world_camera[:3, :3].T + camera.centre_world)


def _tell(gaps: Mapping[tuple[int, str], tuple[float, bool]], names: list[str], limit: float) -> None:
    for (i, part), (gap, lost) in gaps.items():
        if gap > limit:
            print(f"# {names[i]} {part}: {100 * gap:.0f} cm off, {'said to be lost' if lost else 'NOT said'}")
