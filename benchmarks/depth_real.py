"""Real depth images of people, no pose given: the person's size from a few, then a posture in each.

`python -m benchmarks.depth_real FOLDER` writes the pictures of the documentation.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data, figure

_UP = (0.0, -1.0, 0.0)  # the cameras stood level; the world is the camera's frame
_CLOSE, _ACCEPTED = 0.05, 0.10  # [m] from the visible surface: explained; a point of the body at all
_SIZED = 4  # first images, from which the size is taken


def run() -> None:
    """Print the figures."""
    for name, load in (("sr305", _sr305), ("skeltrack", _skeltrack)):
        images = load()
        if images is None:
            for what, unit, goal in (("mm", "mm", "<= 15"), ("explained", "of body points", ">= 0.85")):
                figure(f"real_{name}_{what}", None, unit, goal, "no recording")
            continue
        distances, shares = [], []
        for depth, camera, start, body in fitted(*images):
            distance, share = explained(body, start.state, camera, depth)
            distances.append(distance)
            shares.append(share)
        figure(f"real_{name}_mm", 1e3 * float(np.median(np.concatenate(distances))), "mm", "<= 15")
        figure(f"real_{name}_explained", float(np.mean(shares)), f"of body points, {len(shares)} images", ">= 0.85")
        good = float(np.mean(np.array(shares) >= 0.85))
        figure(f"real_{name}_images", good, "of images with 85 % explained", ">= 0.75")


def _sr305() -> tuple[list[NDArray], Any] | None:
    """Both sequences; the one in which the person faces the camera first."""
    import cv2

    folder = data("depth_sr305_upperbody")
    if folder is None:
        return None
    files = [f for s in ("231615", "230536") for f in sorted(folder.glob(f"*-{s}/*.png"), key=lambda f: int(f.stem))]
    images = [0.000125 * cv2.imread(str(f), cv2.IMREAD_UNCHANGED).astype(float) for f in files[: amount(None, 1)]]
    return images, _camera(476.007, 313.683, 242.755)


def _skeltrack() -> tuple[list[NDArray], Any] | None:
    """All images, of two people in view the nearer one; without intrinsics: those of any first Kinect."""
    from kinefit.images.depth_scene import people

    folder = data("depth_skeltrack_kinect1")
    if folder is None:
        return None
    camera, images = _camera(577.0, 320.0, 240.0), []
    for file in sorted(folder.glob("depth-data-*"))[: amount(None, 1)]:
        depth = 0.001 * np.fromfile(file, "<u2").reshape(480, 640)
        blobs = people(depth, camera)
        if len(blobs) > 1:
            far = max(blobs, key=lambda b: b.centre[2])
            depth = np.where(far.mask, 0.0, depth)
        images.append(depth)
    return images, camera


def _camera(focal: float, cx: float, cy: float) -> Any:
    from kinefit import Camera

    return Camera("depth", (640, 480), np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]]))


def fitted(images: list[NDArray], camera: Any) -> Any:
    """(depth, camera, start, body) of every image."""
    from kinefit import load_body
    from kinefit.fitting.initialization.from_depth import sized_start, start_from_points

    fit, _ = sized_start(load_body("humanoid10"), images[:_SIZED], camera, up=_UP)
    for depth in images:
        yield depth, camera, start_from_points(fit.body, None, camera, depth, up=_UP)[0], fit.body


def explained(body: Any, state: Any, camera: Any, depth: NDArray) -> tuple[NDArray, float]:
    """Distances (N,) [m] of accepted points from the visible surface, and the share of all that are close to it."""
    from kinefit.bodies.surfaces.places import nearest
    from kinefit.images.depth import to_points

    points = to_points(depth, camera, step=3)
    found = nearest(body, state, points, max_distance=_ACCEPTED)
    visible = np.einsum("ij,ij->i", found.normal, camera.centre_world - found.point) > 0
    distance = np.abs(found.distance[visible & (found.segment >= 0)])
    return distance, float(np.sum(distance < _CLOSE) / max(len(points), 1))


def picture(body: Any, state: Any, camera: Any, depth: NDArray) -> NDArray:
    """(H, 2 W, 3) uint8: depth in colours, and beside it the body drawn over it."""
    import cv2

    from kinefit.bodies.rendering import render_body
    from kinefit.bodies.surfaces.places import body_mesh

    mesh = body_mesh(body)
    raster = render_body(body, state, camera, mesh=mesh)
    near, far = np.percentile(depth[depth > 0], (1, 99))
    level = np.where(depth > 0, 255 * (1 - 0.8 * np.clip((depth - near) / (far - near), 0, 1)), 0).astype(np.uint8)
    left = cv2.applyColorMap(level, cv2.COLORMAP_TURBO) * (depth > 0)[..., None].astype(np.uint8)
    hue = np.linspace(0, 179, len(body.tree.segments), endpoint=False).astype(np.uint8)
    bright = np.stack([hue, np.full_like(hue, 200), np.full_like(hue, 255)], axis=-1)
    colours = cv2.cvtColor(bright[None], cv2.COLOR_HSV2BGR)[0]
    gy, gx = np.gradient(np.where(raster.seen, raster.depth, 0.0))
    shade = 0.35 + 0.65 / np.sqrt(1 + (camera.matrix[0, 0] / raster.depth.clip(0.1, 10)) ** 2 * (gx**2 + gy**2))
    grey = np.repeat(level[..., None] // 2, 3, axis=2)
    right = np.where(raster.seen[..., None], 0.7 * colours[raster.segment] * shade[..., None] + 0.3 * grey, grey)
    return np.concatenate([left, right.astype(np.uint8)], axis=1)


def pictures(folder: Path) -> None:
    """Pictures of the documentation, of the SR305 alone (MIT, Ladislav Ondris)."""
    import cv2

    images = _sr305()
    if images is None:
        return
    chosen = [item for k, item in enumerate(fitted(images[0][:6], images[1])) if k in (0, 5)]
    rows = [cv2.resize(picture(body, start.state, camera, depth), (800, 300)) for depth, camera, start, body in chosen]
    cv2.imwrite(str(folder / "depth_start.png"), np.concatenate(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    pictures(Path(sys.argv[1])) if len(sys.argv) > 1 else run()
