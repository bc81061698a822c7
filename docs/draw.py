"""Images of the pages: `python docs/draw.py NAME ...` draws those that `DRAWN` names, `python docs/draw.py` lists all.

Those that benchmarks draw are in `BENCHMARKS`, each with its command. Real recordings are read below $KINEFIT_DATA;
`kinefit demo` fetches its own. Pages in the browser need Chromium. Results that several images show are kept in the
folder kinefit-drawn of the system's temporary files: delete it after a change of what they show.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

DRAWN = {
    "app.png": "pages",
    "bar_coverage.png": "recordings",
    "body_skin.png": "bodies",
    "check.png": "pages",
    "demo.webp": "bodies",
    "depth_fusion.jpg": "recordings",
    "gait.svg": "recordings",
    "init_click.png": "pages",
    "live.jpg": "pages",
    "markers.svg": "plans",
    "metaball_skin.png": "bodies",
    "one_camera.jpg": "recordings",
    "people.jpg": "recordings",
    "plate_strain.png": "recordings",
    "replay.jpg": "bodies",
    "report.png": "pages",
    "silhouettes.jpg": "recordings",
    "simulate.jpg": "recordings",
    "studio.svg": "plans",
    "view.png": "pages",
}
"""{image: the module of docs/drawing whose function of the image's name draws it}."""

BENCHMARKS = {
    "anny.jpg": "python -m benchmarks silhouettes silhouettes_anny",
    "depth_start.png": "python -m benchmarks.accuracy.depth.depth_real docs/images",
    "markers_synthetic.svg": "python -m benchmarks.papers.markers.markers_synthetic docs/images/markers_synthetic.svg",
    "morphing_arm.svg": "python -m benchmarks silhouettes silhouettes_morphing",
    "morphing_torso.jpg": "python -m benchmarks silhouettes silhouettes_torso",
    "people_cases.jpg": "python -m benchmarks.accuracy.people.people_pictures docs/images/people_cases.jpg",
    "recipe_metaballs.png": "python -m benchmarks.papers.recipe_pictures",
    "recipe_regions.png": "python -m benchmarks.papers.recipe_pictures",
    "regions_cyclist.jpg": "python -m benchmarks regions regions_gear",
    "regions_cyclist.svg": "python -m benchmarks regions regions_gear",
    "regions_jump.jpg": "python -m benchmarks regions regions_jumps",
    "regions_rider_rises.jpg": "python -m benchmarks regions regions_jumps",
    "regions_snowboarder.jpg": "python -m benchmarks regions regions_gear",
    "regions_snowboarder.svg": "python -m benchmarks regions regions_gear",
    "regions_snowboarder_feet.svg": "python -m benchmarks regions regions_gear",
    "silhouettes_basin.svg": "python -m benchmarks silhouettes silhouettes_basin",
    "silhouettes_cat.jpg": "python -m benchmarks silhouettes silhouettes_cat",
    "surface_limb.png": "KINEFIT_PICTURES=docs/images python -m benchmarks photogrammetry surface_arm",
    "voodoo.jpg": "python -m benchmarks.papers.voodoo.depth_voodoo_picture",
}
"""{image: the command that draws it}."""

BY_HAND = ("how_it_works.svg", "rooms.svg")
"""Diagrams that are written as text: the file is its own source."""


def main(names: list[str]) -> None:
    """Draw images by their names without the ending, or list all."""
    modules = {Path(image).stem: module for image, module in DRAWN.items()}
    for name in names:
        if name not in modules:
            raise SystemExit(f"'{name}' is not drawn here. There are: {', '.join(modules)}.")
        getattr(importlib.import_module(f"drawing.{modules[name]}"), name)()
    if not names:
        here = {image: f"python docs/draw.py {Path(image).stem}" for image in DRAWN}
        for image, command in sorted((here | BENCHMARKS).items()):
            print(f"{image:<30} {command}")


if __name__ == "__main__":
    main(sys.argv[1:])
