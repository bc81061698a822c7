"""`kinefit warmup`: compile the kernels, and fetch what draws the plots of reports, before they are needed."""

from __future__ import annotations

from concurrent.futures import as_completed
from time import perf_counter
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen
from kinefit.errors import AssetError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PARTS = "surfaces", "keypoints", "depth"  # the longest first
_PROCESSES = 2  # more would compile the kernels that the parts share once more, instead of loading them


@click.command(short_help="Compile the kernels now, so that the first run starts at once.", epilog="""\b
Examples:
  kinefit warmup
  KINEFIT_CACHE=/var/cache/kinefit kinefit warmup     store them in another folder
""")  # fmt: skip
@_screen.verbose_option
def warmup() -> None:
    """Compile the kernels now and store them, so that later commands start at once.

    Also downloads plotly.js (10 MB), which draws the plots of reports: afterwards a computer needs no network.
    """
    from kinefit._jit import kernel_folder
    from kinefit._threads import Pool
    from kinefit.readers import assets

    begin = perf_counter()
    with _screen.bars() as step, Pool(_PROCESSES) as pool:
        step("compiling", 0, len(_PARTS))
        for done, part in enumerate(as_completed([pool.submit(_compile, name) for name in _PARTS]), 1):
            part.result()
            step("compiling", done, len(_PARTS))
        try:
            assets.fetch(assets.PLOTLY_PACKAGE, lambda got, total: step("download MB", got // 10**6, total // 10**6))
        except AssetError as error:
            _screen.note(f"Reports have no plots until plotly.js is there. {error}")
    kept = kernel_folder()
    where = f"kernels are in {kept.parent}" if kept else "not stored: set KINEFIT_CACHE to a writable folder"
    _screen.say(f"ready after {perf_counter() - begin:.1f} s; {where}")


def _compile(part: str) -> None:
    """Use the kernels of one kind of take once."""
    from kinefit.simulation.recordings import warm_depth, warm_keypoints

    {"surfaces": _surfaces, "keypoints": warm_keypoints, "depth": warm_depth}[part]()


def _surfaces() -> None:
    """Two states of a textured limb before three cameras, followed and strained; a body of metaballs moved by it."""
    import numpy as np

    from kinefit.bodies import load_body
    from kinefit.fitting.tracking.tracker import Tracker
    from kinefit.geometry.camera import Camera, Rig
    from kinefit.geometry.se3 import transform
    from kinefit.images.photogrammetry.least_squares_matching import Grid
    from kinefit.images.photogrammetry.spline_image import SplineImage
    from kinefit.images.photogrammetry.surface import measure_states, surface_strain
    from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
    from kinefit.observations import SurfacePointFrame
    from kinefit.sensors.surfaces.surface_points import SurfacePointSensor

    random, places = np.random.default_rng(0), (0.0, -0.12, 0.12)
    K = np.array([[300.0, 0.0, 79.5], [0.0, 300.0, 59.5], [0.0, 0.0, 1.0]])
    cameras = [Camera(f"camera {k}", (160, 120), K, T_camera_world=transform(np.eye(3), np.array([-x, 0.0, 1.0])))
               for k, x in enumerate(places)]  # fmt: skip
    rig, fine = Rig(tuple(cameras)), np.cumsum(np.cumsum(random.normal(size=(140, 320)), axis=0), axis=1)
    fine = 120.0 + 40.0 * _white(fine)
    states = [
        [SplineImage.of(fine[10 + k : 130 + k, 80 + round(300 * x) + k :][:, :160] + random.normal(size=(120, 160)))
         for x in places]
        for k in (0, 1)
    ]
    grid = Grid.of((160, 120), 8, margin=12)
    first, second = measure_states(rig, states, grid)
    surface_strain(first, second, 0.1, 13)
    tracker = SurfaceTracker(rig, 30.0, SurfaceTracking(step=8))
    for images in states:
        points = tracker.update(images)
    body = load_body("arm_metaballs")
    follower = Tracker(body, rig, rate=30.0, sensors=[SurfacePointSensor("surface")], up="y")
    follower.start_at(body.default_state())
    for k in range(3):
        frame = SurfacePointFrame("surface", k / 30.0, points.ids, points.x_world, points.covariance)
        follower.update([frame])


def _white(texture: NDArray) -> NDArray:
    """A texture of grains of a few pixels, mean 0 and deviation 1: a random walk less its surroundings."""
    import cv2

    fine = cv2.GaussianBlur(texture, (0, 0), 1.0) - cv2.GaussianBlur(texture, (0, 0), 3.0)
    return (fine - fine.mean()) / fine.std()
