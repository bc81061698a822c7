"""Figures of stereo pairs, of faces and hands by colour, and of free space and collisions.

`python -m benchmarks depth depth_stereo`; the real recordings are read below `KINEFIT_DATA`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import NotMeasured, amount, data, each, figure, recording
from benchmarks.timing import timed, took
from kinefit.bodies import load_body
from kinefit.bodies.surfaces.places import sample
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images.stereo import StereoRectifier
from kinefit.readers.calibration.read import read_opencv_stereo
from kinefit.solving.correspondences import collision_rows, free_space_rows
from kinefit.solving.correspondences.occupancy.free_space import FreeSpace, SurfaceSamples, collision_pairs

PAIRS = amount((1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14), (1, 5, 9))
SQUARE = 0.025  # [m]
REPEATS = 100  # of work whose median time is told


def run() -> None:
    """Print every figure."""
    each(_board, _head, _skin, _space)


def _cpu(work: Callable[[], object]) -> float:
    """[ms] CPU time of a call, the median of many."""
    work()
    return 1e3 * float(np.median([took(work)[1] for _ in range(REPEATS)]))


def _board() -> None:
    folder = recording("stereo_opencv_chessboard")
    names = ("stereo board squares", "stereo board flatness", "stereo corners found", "stereo corners one period off")
    rig = read_opencv_stereo(folder / "intrinsics.yml", folder / "extrinsics.yml", unit=SQUARE, image_size=(640, 480))
    pair = StereoRectifier(*rig.cameras, near=0.2, far=1.5)
    squares, flat, found, beside = [], [], [], []
    for k in PAIRS:
        left, right = (cv2.imread(str(folder / f"{s}{k:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for s in ("left", "right"))
        x = _corners(pair, left, right)
        seen = np.isfinite(x).all(axis=-1)
        found.append(seen.mean())
        squares += [float(np.nanmedian(np.linalg.norm(np.diff(x, axis=axis), axis=-1))) for axis in (0, 1)]
        points = x[seen]
        near = points[np.abs(points - np.median(points, axis=0)).max(axis=1) < 0.2]
        normal = np.linalg.svd(near - near.mean(axis=0))[2][-1]
        flat.append(float(np.median(np.abs((near - near.mean(axis=0)) @ normal))))
        beside += list(np.abs((points - near.mean(axis=0)) @ normal) > 0.02)
    figure(names[0], 100 * abs(float(np.mean(squares)) / SQUARE - 1), "%", "<= 1")
    figure(names[1], 1e3 * float(np.median(flat)), "mm", "<= 1")
    figure(names[2], 100 * float(np.mean(found)), "%", ">= 90")
    figure(names[3], 100 * float(np.mean(beside)), "%", "<= 5")


def _corners(pair: StereoRectifier, left: NDArray, right: NDArray) -> NDArray:
    """(6, 9, 3) [m] corners of the board in the rectified camera's frame."""
    view, _ = pair.rectify(left, right)
    _, corners = cv2.findChessboardCorners(view, (9, 6))
    corners = cv2.cornerSubPix(view, corners, (4, 4), (-1, -1), (3, 30, 0.01)).reshape(-1, 2)
    depth, z = pair.depth(left, right), []
    for u, v in np.rint(corners).astype(int):
        near = depth[v - 3 : v + 4, u - 3 : u + 4]
        z.append(np.median(near[near > 0]) if (near > 0).sum() > 10 else np.nan)
    K = pair.camera.matrix
    return (np.c_[(corners - K[:2, 2]) / K[0, 0], np.ones(len(corners))] * np.array(z)[:, None]).reshape(6, 9, 3)


def _head() -> None:
    """A walking person before a simulated stereo head, 3 m away."""
    folder = recording("motion_cmu_bvh")
    from kinefit.readers.skeletons.bvh import read_bvh
    from kinefit.simulation.figures import look_at
    from kinefit.simulation.rendering.scenes import STEREO, SimulatedScene, picture
    from kinefit.simulation.retarget import retarget

    motion = retarget(read_bvh(sorted(folder.glob("*.bvh"))[0]), rate=2)
    off, found, spent = [], [], list[float]()
    for frame in range(1, len(motion.angles), amount(2, 20)):
        aim = motion.Ts_world_root[frame][:3, 3]
        place = aim + (0.3, 0.2, 3.0)
        left, right = STEREO.pair(STEREO.camera(look_at(place, aim, np.array([0.0, 1.0, 0.0]))))
        scene = SimulatedScene.of(motion, left)
        images = [picture(scene, frame, c, STEREO, grey=True) for c in (left, right)]
        pair = StereoRectifier(left, right, near=1.0, far=8.0)
        with timed(spent):
            depth = pair.depth(*images)
        view = scene.view(frame, pair.camera)
        body = (view.raster.face >= 0) & (scene.labels[view.raster.face] < len(motion.body.tree.segments))
        seen = body & (depth > 0)
        found.append(seen.sum() / body.sum())
        off.append((depth - view.raster.depth)[seen] / pair.deviation(3.0, 1.0))
    figure("stereo head, depth of the body at 3 m", float(np.median(np.abs(np.concatenate(off)))), "px", "<= 0.25")
    figure("stereo head, body pixels found", 100 * float(np.mean(found)), "%", ">= 90")
    figure("stereo head, CPU a 320x240 pair", 1e3 * sum(spent) / len(off), "ms", "<= 33")


def _skin() -> None:
    folder = data("mv4_upperbody_caliscope")
    names = (
        "skin, face seen",
        "skin, face from the nose",
        "skin, hands seen",
        "skin, hands from the palms",
        "skin, CPU",
    )
    try:
        from kinefit.errors import KinefitError
        from kinefit.images.detectors.box_detector import Models
        from kinefit.readers import assets

        if folder is None:
            raise FileNotFoundError("no recording")
        models = Models(assets.detector_models())
    except (KinefitError, FileNotFoundError) as error:
        raise NotMeasured(str(error).split(".")[0]) from error
    parts = [_gestures(folder, port, models) for port in (1, 2, 3)]
    off, cpu = np.concatenate([p[0] for p in parts]), float(np.median([p[1] for p in parts]))
    for k, (share, gap, goal) in enumerate(((names[0], names[1], "0.25"), (names[2], names[3], "0.35"))):
        those = off[off[:, 0] == k, 1]
        figure(share, 100 * float(np.isfinite(those).mean()), "%", ">= 90")
        figure(gap, float(np.nanmedian(those)), "heights of the face", f"<= {goal}")
    figure(names[4], cpu, "ms", "<= 10")


def _gestures(folder: Path, port: int, models: object) -> tuple[NDArray, float]:
    """(N, 2): 0 for the face and 1 for a hand, and how far it is from where the networks see it; NaN for unseen."""
    from kinefit.images.detectors.following import Follower
    from kinefit.images.detectors.skin import SkinTracker, find_face
    from kinefit.readers.videos.video import Video

    follower, rows, times = Follower(models, 6.0, people=1, masks=False), [], []  # type: ignore[arg-type]
    with Video(folder / f"port_{port}.mp4") as video:
        image = video.read(0)
        face = find_face(image, models)  # type: ignore[arg-type]
        assert face is not None
        tracker, size = SkinTracker(image, face, rate=6.0), np.array(video.size)
        for k in range(amount(60, 6)):  # then a board is held
            image = video.read(k)
            with timed(times):
                seen = tracker.update(image)
            for person in follower.update(image):
                for blob, points in zip(seen, ([0], [15, 17, 19], [16, 18, 20])):
                    middle = person.points[points].mean(axis=0)
                    if person.confidence[points].min() > 0.6 and np.all((middle >= 0) & (middle < size)):
                        gap = np.linalg.norm(blob.centre - middle) / face[3] if blob else np.nan
                        rows.append((float(points != [0]), gap))
    return np.array(rows), 1e3 * float(np.median(times))


def _space() -> None:
    """A person 2.7 m away before a wall, 640x480, 1,000 samples of the surface."""
    body = load_body("humanoid")
    camera = Camera("depth", (640, 480), [[550.0, 0, 319.5], [0, 550.0, 239.5], [0, 0, 1]])
    state = body.default_state(se3.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 2.7])))
    depth = np.full((480, 640), 4.2, np.float32)
    depth[60:420, 250:370] = 2.6
    points, normals, segment = sample(body, 1000)
    samples, pairs = SurfaceSamples(segment, points.T, normals.T), collision_pairs(body)
    shown = np.where(depth[::4, ::4] < 3.0, depth[::4, ::4], np.float32(np.inf))
    space = FreeSpace.of(depth, farthest=3.2, shown=shown)
    figure("free space, CPU a 640x480 image", _cpu(lambda: FreeSpace.of(depth, farthest=3.2)), "ms", "<= 0.3")
    spent = _cpu(lambda: FreeSpace.of(depth, farthest=3.2, shown=shown))
    figure("free space, CPU with what the body explains", spent, "ms", "<= 0.6")
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    spent = _cpu(lambda: free_space_rows(frames, samples, space, camera))
    figure("free space, CPU 1,000 samples", spent, "ms", "<= 0.1")
    figure("collisions, CPU 171 pairs", _cpu(lambda: collision_rows(body, state, pairs=pairs)), "ms", "<= 0.1")
