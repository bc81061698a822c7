"""A rigid free-form object in real images (P1 2.4's car): the toy of `region_cat`, by the silhouette of its colour.

Its mesh, its first pose, and a threshold on hue and saturation go into a take file; `kinefit track` does the rest. The
threshold was chosen on the first image, before any tracking. Regions (`benchmarks.regions_cat`) need no threshold.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import amount, data, figure
from benchmarks.regions_cat import camera, images, take_of, truth
from benchmarks.regions_scene import away
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.takes.track import track_take

COLOUR = 'format = "threshold"\nchannels = "hsv"\nlow = [14, 115, 50]\nhigh = [34, 255, 255]\nsigma = 2.0\n'
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "silhouettes_cat.jpg"
DRAWN = amount(PICTURE, None)


def take_by_silhouettes(folder: Path, work: Path, first: np.ndarray, frames: int | None = None) -> Path:
    """The take file of the recording with silhouettes in place of regions."""
    path = take_of(folder, work, first)
    text = path.read_text().replace("[[region]]", "[[silhouette]]") + COLOUR
    if frames is not None:
        text = text.replace("[take]\n", f"[take]\nframes = [0, {frames}]\n", 1)
    path.write_text(text)
    return path


def run(picture: Path | None = DRAWN) -> None:
    """Print the figures, and draw the picture."""
    folder = data("region_cat")
    names = "cat by silhouettes: images right", "cat by silhouettes: median turn", "cat by silhouettes: median place"
    if folder is None:
        for name, unit, goal in zip(names, ("images", "deg", "mm"), (">= 28", "<= 5", "<= 50")):
            figure(name, None, unit, goal, "no recording region_cat")
        return
    count = len(images(folder))
    true = truth(folder, count)
    with tempfile.TemporaryDirectory() as work:
        motion = track_take(take_by_silhouettes(folder, Path(work), true[0]))[0]
    off = np.array([away(motion.Ts_world_root[i], true[i]) for i in range(1, count)])
    right = (off < (50.0, 5.0)).all(axis=1)
    print("#   errors [deg]: " + " ".join(f"{e:.1f}" for e in off[:, 1]))
    print("#   errors [mm]: " + " ".join(f"{e:.0f}" for e in off[:, 0]))
    print(f"#   lowest quality {motion.quality.min():.2f}")
    figure(names[0], float(right.sum()), f"of {len(right)} images, to 5 cm and 5 deg", ">= 28")
    figure(names[1], float(np.median(off[:, 1])), "deg; the truth is good to 2.4", "<= 5")
    figure(names[2], float(np.median(off[:, 0])), "mm; the truth is good to 5.5", "<= 50")
    if picture:
        draw(picture, folder, motion)


def draw(picture: Path, folder: Path, motion: Motion) -> None:
    """Outlines of the tracked mesh on six images, cut out."""
    seen, view, tiles = images(folder), camera(folder), []
    mesh = body_mesh(motion.body)
    for i in np.linspace(0, len(seen) - 1, 6).astype(int):
        body = render_body(motion.body, motion.state(int(i)), view, mesh=mesh).seen.astype(np.uint8)
        image = seen[i][..., ::-1].copy()
        cv2.drawContours(image, cv2.findContours(body, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], -1, (0, 255, 0), 1)
        v, u = (int(np.clip(np.mean(k), 100, n - 100)) for k, n in zip(np.nonzero(body), body.shape))
        tiles.append(image[v - 100 : v + 100, u - 100 : u + 100])
    cv2.imwrite(str(picture), np.hstack(tiles), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    run()
