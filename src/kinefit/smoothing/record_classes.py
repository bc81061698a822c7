"""The classes of records that are kept while a take is tracked and smoothed; no other is read from a file."""

from __future__ import annotations

from kinefit._records import Codec
from kinefit.bodies import BodyState, PointSet
from kinefit.bodies.surfaces import SurfaceAnchors
from kinefit.correspondences.contours.rims import Rim
from kinefit.frame.results import FrameResult
from kinefit.images.regions import Ratios, RegionColours
from kinefit.losses import Loss
from kinefit.sensors.base import Leftover, RowsOf
from kinefit.sensors.depth_image import DepthImageMatched, DepthImageMeasurement
from kinefit.sensors.displaced import Displaced, DisplacedMatched
from kinefit.sensors.image_lines import ImageLineMatched, ImageLineMeasurement
from kinefit.sensors.keypoints import KeypointMatched, KeypointMeasurement
from kinefit.sensors.lifted import LiftedMatched, LiftedMeasurement
from kinefit.sensors.markers import MarkerMatched, MarkerMeasurement
from kinefit.sensors.occlusion import Hidden
from kinefit.sensors.point_cloud import PointCloudMatched, PointCloudMeasurement
from kinefit.sensors.region_image import Coloured, Kept
from kinefit.sensors.region_matched import RegionMatched
from kinefit.sensors.region_parts import Lines
from kinefit.sensors.region_seams import Seams
from kinefit.sensors.regions import RegionMeasurement
from kinefit.sensors.silhouette import SilhouetteMatched, SilhouetteMeasurement
from kinefit.sensors.surface_match import FreePairs, SurfacePairs
from kinefit.sensors.surface_points import SurfacePointMatched, SurfacePointMeasurement

CODEC = Codec([
    BodyState, PointSet, SurfaceAnchors, Rim, FrameResult, Ratios, RegionColours, Loss, Leftover, RowsOf,
    DepthImageMatched, DepthImageMeasurement, Displaced, DisplacedMatched, ImageLineMatched, ImageLineMeasurement,
    KeypointMatched, KeypointMeasurement, LiftedMatched, LiftedMeasurement, MarkerMatched, MarkerMeasurement, Hidden,
    PointCloudMatched, PointCloudMeasurement, Coloured, Kept, RegionMatched, Lines, Seams, RegionMeasurement,
    SilhouetteMatched, SilhouetteMeasurement, FreePairs, SurfacePairs, SurfacePointMatched, SurfacePointMeasurement,
])  # fmt: skip
"""Writes and reads records of tracked frames. What belongs to all frames (bodies, sensors, cameras) is none of them."""
