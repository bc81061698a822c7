"""Images of what commands write of people, depth sensors, silhouettes, a bar, a plate and a walk."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
from benchmarks.bar_scene import bar_rig, draw_bar, wave_bar
from benchmarks.curves import curves
from benchmarks.silhouettes_track import take_text
from numpy.typing import NDArray

from drawing import results
from kinefit import read_motion
from kinefit.bodies.rendering import render_body
from kinefit.bodies.rendering.looks import LEFT_COLOUR, RIGHT_COLOUR, to_hex
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.exporters import draw_overlay, write_motion
from kinefit.exporters.pictures.drawing import draw_body
from kinefit.exporters.report.cycles import PERCENT, find_cycles, normalised
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.take.videos import TakePictures
from kinefit.readers.videos.video import Video
from kinefit.simulation import cut, movement, retarget, squat_and_wave, write_synthetic_take
from kinefit.takes.missing import find_cameras

_TO_CALIBRATION = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def people() -> None:
    """Two people who were tracked together, each with the fitted skeleton, in all views."""
    place, out = results.two_people(), results.folder("people")
    if not (out / "person-2" / "motion.npz").is_file():
        results.command("track", place, "--no-overlays", "--no-report", "-q", "--out", out)
    motions = [read_motion(out / person / "motion.npz") for person in ("person-1", "person-2")]
    take = read_take(place / "take.toml")
    seen, shown = load_observations(take), []
    assert seen.rig is not None
    with TakePictures(take, seen) as pictures:
        for camera in seen.rig:
            image, frame = pictures(camera.name, 50)  # type: ignore[misc]
            image = np.array(image)
            for motion in motions:
                draw_body(image, motion, 50, camera, frame)
            shown.append(results.reduced(image, width=248))
    height = min(image.shape[0] for image in shown)
    results.save("people.jpg", np.hstack([image[:height] for image in shown])[..., ::-1])


def one_camera() -> None:
    """The same two people before one of the cameras, which is not calibrated: each with the fitted skeleton."""
    place = results.folder("one_camera")
    take, out = place / "take.toml", place / "results"
    if not (out / "person-2" / "motion.npz").is_file():
        shutil.copy(results.two_people() / "cam01.mp4", place / "phone.mp4")
        results.command("init", place, "--force")
        results.command("track", take, "--no-overlays", "--no-report", "-q", "--out", out)
    camera, shown = load_observations(find_cameras(read_take(take))).rig.cameras[0], []  # type: ignore[union-attr]
    with Video(place / "phone.mp4") as video:
        for person in ("person-1", "person-2"):
            motion = read_motion(out / person / "motion.npz")
            T_level_world = np.array(motion.provenance["floor"]["T_level_world"])  # the floor was found, and levelled
            levelled = camera.with_pose(camera.T_camera_world @ np.linalg.inv(T_level_world))
            image = draw_overlay(video.read(50), motion, 50, levelled)
            shown.append(results.reduced(image, height=668))
    results.save("one_camera.jpg", np.hstack(shown)[..., ::-1])


def simulate() -> None:
    """What the simulated sensors see: the preview of `kinefit simulate`."""
    out = results.folder("simulate")
    write_motion(cut(squat_and_wave(), 30, 33), out / "motion.npz")
    sensors = [word for sensor in ("tof", "kinect", "stereo", "colour") for word in ("--sensor", sensor)]
    results.command("simulate", out / "motion.npz", "-o", out / "seen", *sensors)
    results.save("simulate.jpg", cv2.imread(str(out / "seen" / "preview.png")))


def depth_fusion() -> None:
    """Overlays of depth sensors: a simulated Kinect, and an SR305 before a real person."""
    out = results.folder("depth_fusion")
    write_motion(movement("bow", rate=15.0), out / "motion.npz")
    results.command("simulate", out / "motion.npz", "-o", out / "seen", "--sensor", "kinect")
    results.command("track", out / "seen" / "take.toml", "--no-report", "--out", out / "simulated")
    real, files = out / "real", sorted(
        results.data("depth_sr305_upperbody").glob("*-231615/*.png"), key=lambda file: int(file.stem)
    )  # fmt: skip
    (real / "depth").mkdir(parents=True, exist_ok=True)
    for k, file in enumerate(files):
        shutil.copy(file, real / "depth" / f"{k:03d}.png")
    (real / "take.toml").write_text(
        '[take]\nrate = 3.0\nup = "-y"\nbody = "humanoid10"\n[[depth]]\nname = "sr305"\nfile = "depth"\n'
        "unit = 0.000125\nrange = [0.2, 1.5]\nintrinsics = [476.007, 476.007, 313.683, 242.755]\n"
    )
    results.command("track", real / "take.toml", "--no-report", "--out", out / "tracked")
    rows = []
    for folder in ("simulated", "tracked"):
        with Video(next((out / folder / "overlays").glob("*.mp4"))) as video:
            at = np.linspace(0.1, 0.9, 4) * (len(video) - 1)
            rows.append(np.hstack([results.reduced(video.read(round(i)), width=315) for i in at]))
    results.save("depth_fusion.jpg", np.vstack(rows)[..., ::-1])


def silhouettes() -> None:
    """Contours of the given masks and of the segments of the body that was fitted to them, in four cameras."""
    out = results.folder("silhouettes")
    (out / "take.toml").write_text(take_text(results.data("video_balancing_4cam"), "masks"))
    if not (out / "results" / "motion.npz").is_file():
        results.command("track", out / "take.toml", "--no-report", "--no-overlays", "--out", out / "results")
    motion = read_motion(out / "results" / "motion.npz")
    take = read_take(out / "take.toml")
    seen, mesh, rows = load_observations(take), body_mesh(motion.body), []
    assert seen.rig is not None
    with TakePictures(take, seen) as pictures:
        for i in (10, 70):
            row = []
            for masks in seen.silhouettes:
                camera = seen.rig[masks.sensor]
                image, frame = pictures(masks.sensor, i)  # type: ignore[misc]
                shown = cv2.warpAffine(image, frame.T_image_calibration[:2], camera.size, flags=_TO_CALIBRATION)
                shown = shown[..., ::-1].copy()
                segment = render_body(motion.body, motion.state(i), camera, mesh=mesh).segment
                for k in np.unique(segment[segment >= 0]):
                    _contour(shown, segment == k, (60, 200, 60))
                mask = masks.frame(i).mask > 127
                _contour(shown, mask, (60, 60, 230))
                row.append(_around(shown, mask, 315, 465))
            rows.append(np.hstack(row))
    results.save("silhouettes.jpg", np.vstack(rows))


def _contour(image: NDArray, mask: NDArray, colour: tuple[int, int, int]) -> None:
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, found, -1, colour, max(2, image.shape[0] // 500), cv2.LINE_AA)


def _around(image: NDArray, mask: NDArray, width: int, height: int) -> NDArray:
    """The part of an image around a mask, at a size [px]."""
    v, u = np.nonzero(mask)
    high = min(1.15 * max(np.ptp(v), np.ptp(u) * height / width), image.shape[0], image.shape[1] * height / width)
    wide = high * width / height
    top = int(np.clip((v.min() + v.max() - high) / 2, 0, image.shape[0] - high))
    left = int(np.clip((u.min() + u.max() - wide) / 2, 0, image.shape[1] - wide))
    part = image[top : top + int(high), left : left + int(wide)]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)


def bar_coverage() -> None:
    """Where a bar's ends were in each image: what `kinefit calibrate bar` writes of a simulated recording."""
    out = results.folder("bar")
    rig = bar_rig(3, (1280, 720), seed=200)
    for f, ends in enumerate(wave_bar(0.9, 120, low=(-0.7, -0.7, 0.4), high=(0.7, 0.7, 1.7), seed=200)):
        for c, camera in enumerate(rig):
            cv2.imwrite(str(out / f"{camera.name}_{f:03d}.png"), draw_bar(camera, ends, radius=0.02, seed=3 * f + c))
    found = out / "result" / "room.toml"
    found.parent.mkdir(exist_ok=True)
    results.command("calibrate", "bar", out, "--length", 0.9, "-o", found, "--overwrite")
    results.save("bar_coverage.png", results.reduced(cv2.imread(str(found.with_suffix(".png"))), width=900))


def plate_strain() -> None:
    """Strain of a plate with a hole, pulled: two drawn photographs of Kirsch's solution, by `kinefit surface`."""
    out = results.folder("plate")
    for name, strain in (("before", 0.0), ("after", 1e-3)):
        cv2.imwrite(str(out / f"{name}.tiff"), _plate(strain))
    results.command("surface", out / "before.tiff", out / "after.tiff", "--flat", 0.1, "--gauge", 8, "--window", 31,
                    "--smooth", 1, "-o", out / "strain")  # fmt: skip
    picture = next((out / "strain").glob("*strain_yy*.png"))
    results.save("plate_strain.png", results.reduced(cv2.imread(str(picture)), height=700))


def _plate(strain: float, radius: float = 100.0, poisson: float = 0.3) -> NDArray:
    """(H, W) uint8: a speckled plate with a hole, pulled along its rows' normal by a strain far from the hole.

    Displacements are Kirsch's in plane stress (Timoshenko and Goodier, Theory of Elasticity, article 35).
    """
    height, width = 1100, 760
    speckle = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(height, width)), (0, 0), 2.0)
    grey = np.clip(128 + 60 * speckle / speckle.std(), 0, 255).astype(np.float32)
    v, u = np.mgrid[:height, :width].astype(float)
    middle = np.array([0.5 * width, 0.5 * height])
    x, y = u - middle[0], v - middle[1]
    for _ in range(3):  # where a pixel of the pulled plate was before
        moved = _kirsch(x, y, radius, strain, poisson)
        x, y = u - middle[0] - moved[0], v - middle[1] - moved[1]
    out = cv2.remap(grey, (x + middle[0]).astype(np.float32), (y + middle[1]).astype(np.float32), cv2.INTER_LANCZOS4)
    out[np.hypot(x, y) < radius] = 0.0
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def _kirsch(x: NDArray, y: NDArray, a: float, strain: float, poisson: float) -> tuple[NDArray, NDArray]:
    """Displacements along x and y of a plate that is pulled along y."""
    r, angle = np.maximum(np.hypot(x, y), a), np.arctan2(x, y)  # from the load's direction
    kappa, scale = (3.0 - poisson) / (1.0 + poisson), strain * (1.0 + poisson) * a / 4.0
    c, s = np.cos(2.0 * angle), np.sin(2.0 * angle)
    radial = r / a * (kappa - 1.0 + 2.0 * c) + 2.0 * a / r * (1.0 + (kappa + 1.0) * c) - 2.0 * (a / r) ** 3 * c
    around = -scale * (2.0 * r / a + 2.0 * a / r * (kappa - 1.0) + 2.0 * (a / r) ** 3) * s
    along = scale * radial * np.cos(angle) - around * np.sin(angle)
    across = scale * radial * np.sin(angle) + around * np.cos(angle)
    return across, along


def gait() -> None:
    """Knee angles over the gait cycle that the gait laboratory's tutorial prints, tracked and known."""
    out = results.folder("gait")
    walk = retarget(read_bvh(results.data("motion_cmu_bvh") / "cmu_12_01_walk.bvh"), rate=60)
    walk = cut(walk, 1, len(walk))
    take = write_synthetic_take(out / "take", walk)
    results.command("track", take, "--out", out / "results", "--no-overlays", "--no-report", "-q")
    panels = []
    for name, colour in (("left", LEFT_COLOUR), ("right", RIGHT_COLOUR)):
        lines: list[tuple[NDArray, NDArray, str, str]] = []
        tracked = read_motion(out / "results" / "motion.npz")
        for motion, line, dashes in ((tracked, to_hex(colour), ""), (walk, "#222", "4 3")):
            cycles = find_cycles(motion)
            assert cycles is not None
            knee = np.degrees(motion.angles[:, motion.body.tree.coordinates.index(f"knee_angle_{name[0]}")])
            foot = next(side for side in cycles.sides if side.name == name)
            lines += [(PERCENT, curve, line, dashes) for curve in normalised(knee, foot.spans)]
        panels.append((f"{name} knee", lines))
    legend = {"left, tracked": to_hex(LEFT_COLOUR), "right, tracked": to_hex(RIGHT_COLOUR), "known": "#222 4 3"}
    curves(results.IMAGES / "gait.svg", panels, x="gait cycle [%]", y="knee flexion [deg]", legend=legend)
