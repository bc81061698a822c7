"""Points on real textured images that move, followed by `kinefit surface`: right, said to be lost, and unsaid wrong.

Of the places that the first image offers, a point is *right* at the end of a sequence if it is where the reference has
it, *said* if its path ended before, and *unsaid* if it is still reported and is somewhere else. References: the known
displacement of the DIC Challenge (0.1 px; sequence of its four images there and back); of MultiDIC's cylinder its rigid
motion, fitted to every second point and asked of the others (0.1 mm); of clothes and skin in one camera a match of a
window of 41 px, wider than the tracker's 31, from the first image straight to the last one, started where the
neighbours went (2 px). Where it finds nothing the point is *unjudged*. Limits of one camera were chosen on cam02 and
cam04 of the two people, of spheres on the back; figures are of cam01, cam03, of two other recordings and the seated.
The person with shirt and jeans was composited into the images by its authors. Bright spheres: drawn ones with noise and
shading against their true centres, and the real ones on a back and on a seated person who stands up, whose centres in
the first and last image were read by eye (4 px).
"""

from __future__ import annotations

import csv
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_real import take_text
from benchmarks.accuracy.surfaces.stereo_cylinder import (
    CAMERAS,
    SPECKLE,
    WINDOW,
    adjusted,
    calibrated,
    calibration_object,
)
from benchmarks.accuracy.surfaces.stereo_cylinder import SIZE as CYLINDER_SIZE
from benchmarks.accuracy.surfaces.surface_return import read_paths
from benchmarks.commands import printed
from benchmarks.figures import amount, data, figure
from benchmarks.scenes.textured import write_video
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.bright_points import find_spots
from kinefit.images.photogrammetry.least_squares_matching import Grid, match
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import measure, rigid_motion
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.videos.video import Video

RATE = 60.0  # [Hz] that videos are written with
SIDE, JUDGE, AROUND = 31, 41, 60.0  # windows of clothes and of their judge, distance of neighbours [px]
RIGHT_PX, RIGHT_DIC_PX, RIGHT_M, RIGHT_MARK_PX = 2.0, 0.1, 1e-4, 4.0
KINDS = {"right": ">= 80", "said": "<= 20", "unsaid": "<= 1"}


@dataclass(frozen=True)
class Cloth:
    """A box (left, top, right, bottom) [px] on one material in a video, from a frame on, every n-th image."""

    file: str
    box: tuple[int, int, int, int]
    start: int = 0
    every: int = 1


TWO, FRAMES = "video_two_people_4cam", amount(21, 4)
CLOTHES = {
    "shirt": Cloth(f"{TWO}/cam01.mp4", (780, 1010, 930, 1180)),
    "jeans": Cloth(f"{TWO}/cam01.mp4", (650, 1335, 800, 1440)),
    "skin": Cloth(f"{TWO}/cam03.mp4", (585, 570, 720, 800)),
    "singlet": Cloth("video_mono_opencap/STS/video.mp4", (296, 765, 366, 850), 0, 3),
    "shirt_6hz": Cloth("mv4_upperbody_caliscope/port_1.mp4", (590, 320, 760, 540)),
}
Marks = tuple[tuple[float, float, float, float], ...]
"""Centres of spheres read by eye [px]: u, v in the first image and in the last one."""

BACK: Marks = (
    (696.5, 692, 564, 711), (689.5, 738, 577, 743.5), (679, 582, 507, 617), (727, 583, 572, 571.5),
    (771, 765, 707.5, 601.5), (574, 864, 503.5, 845), (658, 866, 578, 841.5), (587, 807, 454, 863),
)  # fmt: skip
SEATED: Marks = (
    (422.5, 856.5, 368.5, 719.5), (459.5, 882, 415.5, 739.5), (413, 937, 400.5, 897.5), (431.5, 909, 408.5, 853),
    (401, 975, 401.5, 963), (373, 983, 377, 971), (403, 1017, 405, 1006), (245, 947, 262, 944),
    (250, 1058, 249.5, 1057), (386, 1116, 386.5, 1115),
)  # fmt: skip
SPHERES = {
    "back": ("video_balancing_4cam/videos/cam03.mp4", 20, 12, 8, BACK),
    "seated": ("video_mono_opencap/STS/video.mp4", 60, 10, 8, SEATED),
}
"""Video, last image, widest spot [px], reach [px], marks."""


def run() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        _challenge(work)
        _cylinder(work)
        for cloth in CLOTHES:
            _cloth(work, cloth)
        _help(work)
        _drawn_spheres()
        for place in SPHERES:
            _spheres(work, place)


def _report(name: str, right: NDArray, live: NDArray, judged: NDArray) -> None:
    """Figures of places (N,): right, still there at the end, with a reference."""
    counts = {"right": live & judged & right, "said": ~live, "unsaid": live & judged & ~right}
    print(f"# {name}: {len(live)} places, {int((live & ~judged).sum())} unjudged")
    for kind, goal in KINDS.items():
        figure(f"sequence_{name}_{kind}", 100 * float(counts[kind].mean()), "% of places", goal)


def _absent(name: str, recording: str) -> None:
    for kind, goal in KINDS.items():
        figure(f"sequence_{name}_{kind}", None, "% of places", goal, f"no recording {recording}")


def _in_pixels(x: NDArray) -> NDArray:
    """Image points [px] of paths by `--flat 1`."""
    return x[..., :2] * (1e3, -1e3)


def _mask(path: Path, size: tuple[int, int], box: tuple[int, int, int, int]) -> None:
    image = np.zeros(size[::-1], np.uint8)
    image[box[1] : box[3], box[0] : box[2]] = 255
    cv2.imwrite(str(path), image)


def _all(count: int, ids: NDArray, values: NDArray) -> NDArray:
    """Values of all places of the first image (count, ...), NaN or False for those without a path."""
    out = np.full((count, *values.shape[1:]), np.nan if values.dtype == float else False, values.dtype)
    inside = ids < count
    out[ids[inside]] = values[inside]
    return out


def _challenge(work: Path) -> None:
    folder = data("dic_challenge_14")
    if folder is None:
        _absent("challenge", "dic_challenge_14")
        return
    files = [folder / f"Sample14 {name}.tif" for name in ("Reference", "L1 Amp0.1b", "L3 Amp0.1b", "L5 Amp0.1b")]
    images = [cv2.imread(str(file))[:588] for file in files]  # the video's format wants even numbers
    order = (0, 1, 2, 3, 2, 1, 0, 3)
    write_video(work / "dic.avi", [images[k] for k in order], RATE, "FFV1")
    step = amount(12, 40)
    printed("surface", work / "dic.avi", "--flat", 1, "--window", 21, "--step", step, "-o", work / "dic")
    places = Grid.of(images[0].shape[1::-1], step, margin=12).points
    ids, x = read_paths(work / "dic" / "trajectories.csv", len(order), RATE)
    end = _all(len(places), ids, _in_pixels(x[-1]))
    truth = np.loadtxt(folder / "command.csv", delimiter=",")
    shift = np.interp(places[:, 0], truth[:, 0], truth[:, 5])
    off = np.linalg.norm(end - places - np.column_stack([shift, np.zeros(len(shift))]), axis=1)
    live = np.isfinite(off)
    _report("challenge", off <= RIGHT_DIC_PX, live, live)


def _cylinder(work: Path) -> None:
    folder = data("stereo_dic_cylinder")
    if folder is None:
        _absent("cylinder", "stereo_dic_cylinder")
        return
    photographs = {n: [cv2.imread(str(folder / "speckledObjectImages" / n / f"{n}_{k}.jpg")) for k in (1, 2, 3)]
                   for n in CAMERAS}  # fmt: skip
    mask = np.zeros(CYLINDER_SIZE[::-1], bool)
    mask[SPECKLE] = True
    grid = Grid.of(CYLINDER_SIZE, 24, mask=mask, margin=30)
    objects = [calibration_object(folder, name) for name in CAMERAS]
    rig = Rig(tuple(calibrated(folder, name, *seen) for name, seen in zip(CAMERAS, objects)))
    start = measure(rig, [SplineImage.of(photographs[n][0][..., ::-1]) for n in CAMERAS], grid, window=WINDOW)
    write_calibration(adjusted(rig, objects, start.uv[start.measured]), work / "calib.toml")
    cv2.imwrite(str(work / "mask.png"), mask.astype(np.uint8) * 255)
    for name in CAMERAS:
        write_video(work / f"{name}.avi", photographs[name], RATE, "FFV1")
    views = [f"{name}={work / name}.avi" for name in CAMERAS]
    options = ["--mask", work / "mask.png", "--window", WINDOW, "--step", 24, "-o", work / "cylinder"]
    printed("surface", work / "calib.toml", *views, *options)
    _, x = read_paths(work / "cylinder" / "trajectories.csv", 3, RATE)
    begun = np.isfinite(x[0, :, 0])
    first, last = x[0, begun], x[-1, begun]
    live = np.isfinite(last[:, 0])
    off = np.full(len(first), np.inf)
    for part in (0, 1):  # each half by the motion of the other
        half = np.arange(len(first)) % 2 == part
        both = ~half & live
        T, _ = rigid_motion(first[both], last[both])
        off[half] = np.linalg.norm(first[half] @ T[:3, :3].T + T[:3, 3] - last[half], axis=1)
    never = np.zeros(max(0, int(start.measured.sum()) - len(live)), bool)  # measured at first, and cut off at once
    live, right = np.append(live, never), np.append(off <= RIGHT_M, never)
    _report("cylinder", right, live, live)


def _frames(cloth: Cloth) -> list[NDArray] | None:
    """BGR images of a sequence; None without the recording."""
    folder = data(cloth.file.split("/")[0])
    if folder is None:
        return None
    with Video(folder.parent / cloth.file) as video:
        return [video.read(cloth.start + cloth.every * k)[..., ::-1].copy() for k in range(FRAMES)]


def _cloth(work: Path, name: str) -> None:
    cloth, step = CLOTHES[name], 8
    images = _frames(cloth)
    if images is None:
        _absent(name, cloth.file.split("/")[0])
        return
    size = images[0].shape[1::-1]
    write_video(work / "cloth.avi", images, RATE, "FFV1")
    _mask(work / "mask.png", size, cloth.box)
    options = ["--flat", 1, "--window", SIDE, "--step", step, "--reach", 12, "--mask", work / "mask.png"]
    printed("surface", work / "cloth.avi", *options, "-o", work / name)
    mask = cv2.imread(str(work / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    grid = Grid.of(size, step, margin=SIDE // 2 + 2, mask=mask)
    places = grid.points[grid.inside]
    ids, x = read_paths(work / name / "trajectories.csv", len(images), RATE)
    end = _all(len(places), ids, _in_pixels(x[-1]))
    off = judged(SplineImage.of(images[0][..., ::-1]), SplineImage.of(images[-1][..., ::-1]), places, end)
    _report(name, off <= RIGHT_PX, np.isfinite(end[:, 0]), np.isfinite(off))


def judged(first: SplineImage, last: SplineImage, begin: NDArray, end: NDArray) -> NDArray:
    """Distance (N,) [px] of points in the last image from a match of wide windows; NaN where that finds none.

    Begins where the median of the neighbours' motion leads, without the point itself.
    """
    live, start = np.isfinite(end[:, 0]), end.copy()
    for p in np.flatnonzero(live):
        near = live & (np.linalg.norm(begin - begin[p], axis=1) <= AROUND)
        near[p] = False
        if near.any():
            start[p] = begin[p] + np.median(end[near] - begin[near], axis=0)
    index = np.flatnonzero(live)
    found = match(first, last, begin[index], start[index], window=JUDGE)
    good = found.found & (found.correlation >= 0.8)
    off = np.full(len(begin), np.nan)
    off[index[good]] = np.linalg.norm(found.uv - end[index], axis=1)[good]
    return off


def _help(work: Path) -> None:
    """Points on a man's back and shorts that are found again where his motion says so (P4-11), on real images."""
    folder, camera, box = data("video_balancing_4cam"), "cam03", (540, 540, 780, 1150)
    names = {"found": ("points", ">= 100"), "right": ("% of those judged", ">= 99")}
    if folder is None:
        for name, (unit, goal) in names.items():
            figure(f"sequence_help_{name}", None, unit, goal, "no recording video_balancing_4cam")
        return
    count = amount(40, 6)
    (work / "take.toml").write_text(take_text(folder, "openpose", False, frames=count))
    printed("track", work / "take.toml", "-o", work / "motion")
    with Video(folder / "videos" / f"{camera}.mp4") as video:
        images = [video.read(k)[..., ::-1].copy() for k in range(count)]
    write_video(work / "man.avi", images, RATE, "FFV1")
    _mask(work / "mask.png", images[0].shape[1::-1], box)
    options = ["--window", SIDE, "--step", 8, "--reach", 12, "--mask", work / "mask.png"]
    calibration = [folder / "Calib_refined_static.toml", f"{camera}={work / 'man.avi'}", "--unit", "m"]
    printed("surface", *calibration, "--motion", work / "motion", *options, "-o", work / "on")
    ids, x = read_paths(work / "on" / "trajectories.csv", count, RATE)
    view, splines = read_calibration(folder / "Calib_refined_static.toml", unit="m")[camera], {}
    with (work / "on" / "returns.csv").open() as lines:
        rows = [row for row in csv.DictReader(lines) if row["found_s"]]
    off = []
    for row in rows:
        lost, found = (round(float(row[name]) * RATE) for name in ("lost_s", "found_s"))
        column = np.flatnonzero(ids == int(row["point"]))
        if not len(column) or not np.isfinite(x[[lost - 1, found], column[0], 0]).all():
            continue  # cut off by the filters
        before, after = (view.project(x[k, column]) for k in (lost - 1, found))
        for k in (lost - 1, found):
            if k not in splines:
                splines[k] = SplineImage.of(images[k][..., ::-1])
        off.append(judged(splines[lost - 1], splines[found], before, after)[0])
    known = np.isfinite(off)
    print(f"# {len(rows)} points found again, {len(off)} after the filters, {int(known.sum())} of them judged")
    figure("sequence_help_found", len(rows), "points", ">= 100")
    right = 100 * float(np.mean(np.array(off)[known] <= RIGHT_PX)) if known.any() else None
    figure("sequence_help_right", right, "% of those judged", ">= 99", "none could be judged")


def _drawn_spheres() -> None:
    """Centroids of drawn spheres 4 to 12 px wide on shaded skin, noise of 2 grey values."""
    rng, off = np.random.default_rng(5), []
    for diameter in (4, 6, 8, 12):
        for _ in range(amount(50, 5)):
            centre = 30 + rng.uniform(-0.5, 0.5, 2)
            image = drawn_sphere(centre, diameter) + rng.normal(0.0, 2.0, (60, 60))
            uv, _ = find_spots(np.clip(np.rint(image), 0, 255), diameter + 2)
            gap = np.linalg.norm(uv - centre, axis=1)
            off += [gap.min()] if (gap < 2).any() else []
    figure("sequence_spheres_drawn", float(np.sqrt(np.mean(np.square(off)))), "px RMS", "<= 0.1")


def drawn_sphere(centre: NDArray, diameter: float) -> NDArray:
    """Image (60, 60) of a bright sphere at (u, v) [px] on skin that brightens to the right, blurred by 0.7 px."""
    fine = (np.arange(480) + 0.5) / 8 - 0.5
    u, v = np.meshgrid(fine, fine)
    sphere = np.hypot(u - centre[0], v - centre[1]) < 0.5 * diameter
    image = cv2.resize(np.where(sphere, 200.0, 90 + 0.5 * (u - 30)), (60, 60), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def _spheres(work: Path, name: str) -> None:
    file, last, diameter, reach, marks = SPHERES[name]
    folder = data(file.split("/")[0])
    if folder is None:
        _absent(f"spheres_{name}", file.split("/")[0])
        return
    with Video(folder.parent / file) as video:
        images = [video.read(k)[..., ::-1].copy() for k in range(last + 1)]
    write_video(work / "spheres.avi", images, RATE, "FFV1")
    mask, table = np.zeros(images[0].shape[:2], np.uint8), np.array(marks)
    for u, v in np.rint(table[:, :2]).astype(int).tolist():
        cv2.circle(mask, (u, v), 6, 255, -1)
    cv2.imwrite(str(work / "mask.png"), mask)
    options = ["--flat", 1, "--bright", diameter, "--reach", reach, "--mask", work / "mask.png"]
    printed("surface", work / "spheres.avi", *options, "-o", work / name)
    uv = _in_pixels(read_paths(work / name / "trajectories.csv", len(images), RATE)[1])
    gaps = np.linalg.norm(uv[0][None] - table[:, None, :2], axis=2)
    gaps[:, ~np.isfinite(uv[-1, :, 0])] = np.inf
    path, live = np.nan_to_num(gaps, nan=np.inf).argmin(axis=1), np.nan_to_num(gaps, nan=np.inf).min(axis=1) <= 6
    right = np.linalg.norm(uv[-1, path] - table[:, 2:], axis=1) <= RIGHT_MARK_PX
    _report(f"spheres_{name}", right, live, np.ones(len(marks), bool))

