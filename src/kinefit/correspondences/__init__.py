"""Observations and a body at a state become rows: one file a kind."""

from kinefit.correspondences.coincidence import coincidence_rows
from kinefit.correspondences.image_lines import edge_rows, image_line_rows
from kinefit.correspondences.parameters import limit_rows, prediction_rows, prior_rows
from kinefit.correspondences.pixels import pixel_rows
from kinefit.correspondences.planes import plane_rows
from kinefit.correspondences.points import point_rows
from kinefit.correspondences.rays import ray_rows

__all__ = [
    "coincidence_rows",
    "edge_rows",
    "image_line_rows",
    "limit_rows",
    "pixel_rows",
    "plane_rows",
    "point_rows",
    "prediction_rows",
    "prior_rows",
    "ray_rows",
]
