"""Row makers: observations and a body at a state to linearised measurements, one file for each kind."""

from kinefit.solving.correspondences.closures import Bands, band_rows, closure_rows, coincidence_rows, joint_bands
from kinefit.solving.correspondences.contours.outlines import (
    morphed_outline_rows,
    morphed_rows,
    outline_pairs,
    outline_rows,
)
from kinefit.solving.correspondences.occupancy.free_space import collision_rows, depth_image_rows, free_space_rows
from kinefit.solving.correspondences.points import (
    edge_rows,
    image_line_rows,
    limit_rows,
    pixel_rows,
    plane_rows,
    point_rows,
    prediction_rows,
    prior_rows,
    ray_rows,
)
from kinefit.solving.correspondences.surfaces import anchored_rows, field_rows, surface_rows, target_rows

__all__ = [
    "Bands", "anchored_rows", "band_rows", "closure_rows", "coincidence_rows", "collision_rows", "depth_image_rows",
    "edge_rows", "field_rows", "free_space_rows", "image_line_rows", "joint_bands", "limit_rows",
    "morphed_outline_rows", "morphed_rows", "outline_pairs", "outline_rows", "pixel_rows", "plane_rows",
    "point_rows", "prediction_rows", "prior_rows", "ray_rows", "surface_rows", "target_rows",
]
