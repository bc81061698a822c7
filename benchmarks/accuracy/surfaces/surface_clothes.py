"""Skin and clothes of real people as surfaces: what texture they have, and what `kinefit surface` finds on them.

The paper's arm (P4 2.4) wears a well textured sweater before three cameras side by side. Recordings at hand show bare
skin, a plain shirt and jeans, before cameras 45 degrees and more apart. Two questions, of boxes in the first image that
lie on one material: how many points the command measures between the two nearest cameras; and, in one camera alone at
60 Hz, how many places are still followed after ten images, there and back within a pixel.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import answer
from benchmarks.figures import amount, data, figure
from kinefit.images.photogrammetry.least_squares_matching import match
from kinefit.images.photogrammetry.matching.multi_image import search_box
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.readers.videos.video import Video

IMAGES, STEP, WINDOW, REACH = 10, 8, 21, 12  # followed images; [px]
LEAST, BACK = 0.8, 1.0  # correlation; [px] from where a place began


@dataclass(frozen=True)
class Patch:
    """A box in the first image of a camera, on one material.

    Parameters
    ----------
    recording, camera, other : folder, camera and the one nearest to it
    box : left, top, right, bottom [px]
    """

    recording: str
    calibration: str
    camera: str
    other: str
    box: tuple[int, int, int, int]


PEOPLE = ("video_two_people_4cam", "Calib.qca.txt")
PATCHES = {
    "skin": Patch(*PEOPLE, "cam03", "cam04", (585, 570, 720, 800)),  # the back of somebody who walks
    "shirt": Patch(*PEOPLE, "cam01", "cam02", (780, 960, 930, 1180)),  # plain, of somebody who stands
    "jeans": Patch(*PEOPLE, "cam01", "cam02", (650, 1335, 800, 1440)),
}


def run() -> None:
    """Print the figures."""
    most: list[int] = []
    for name, patch in PATCHES.items():
        folder = data(patch.recording)
        if folder is None:
            figure(f"surface_clothes_followed_{name}", None, "% of places", ">= 80", f"no recording {patch.recording}")
            continue
        figure(f"surface_clothes_followed_{name}", followed(folder, patch), "% of places", ">= 80")
        most.append(measured(folder, patch))
        print(f"# {name}: {most[-1]} points by kinefit surface between {patch.camera} and {patch.other}")
    figure("surface_clothes_points", max(most, default=None), "points on the best of them", ">= 500",
           "" if most else "no recordings")  # fmt: skip


def followed(folder: Path, patch: Patch) -> float:
    """[%] of places in a box that are followed through the images and back to within a pixel of where they began."""
    with Video(folder / f"{patch.camera}.mp4") as video:
        images = [SplineImage.of(video.read(k)) for k in range(amount(IMAGES, 2) + 1)]
    left, top, right, bottom = patch.box
    grid = np.stack(np.meshgrid(np.arange(left, right, STEP), np.arange(top, bottom, STEP)), axis=-1)
    start = grid.reshape(-1, 2).astype(float)
    uv, good = start, np.ones(len(start), bool)
    for old, new in pairwise([*images, *images[-2::-1]]):
        uv, found = _step(old, new, uv)
        good &= found
    return 100 * float(np.mean(good & (np.linalg.norm(uv - start, axis=1) <= BACK)))


def _step(old: SplineImage, new: SplineImage, uv: NDArray) -> tuple[NDArray, NDArray]:
    box = search_box(old, new, uv, uv, reach=REACH, window=WINDOW)
    found = match(old, new, uv, np.where(np.isfinite(box.uv), box.uv, uv), window=WINDOW)
    return np.where(np.isfinite(found.uv), found.uv, uv), found.found & (found.correlation >= LEAST)


def measured(folder: Path, patch: Patch) -> int:
    """Points that the command measures in the box; none where it finds nothing in common."""
    with tempfile.TemporaryDirectory() as place:
        work, views = Path(place), []
        for camera in (patch.camera, patch.other):
            (work / camera).mkdir()
            with Video(folder / f"{camera}.mp4") as video:
                image = video.read(0)
            cv2.imwrite(str(work / camera / "0.png"), image[..., ::-1])
            views.append(f"{camera}={work / camera / '0.png'}")
            if camera == patch.camera:
                mask = np.zeros(image.shape[:2], np.uint8)
                mask[patch.box[1] : patch.box[3], patch.box[0] : patch.box[2]] = 255
                cv2.imwrite(str(work / "mask.png"), mask)
        options = ["--mask", work / "mask.png", "--window", 31, "--least", 0.7, "-o", work / "out"]
        _, told = answer("surface", folder / patch.calibration, *views, *options)
        table = work / "out" / "points_000.csv"
        print(f"  {told[:160]}")
        return len(table.read_text().splitlines()) - 1 if table.exists() else 0
