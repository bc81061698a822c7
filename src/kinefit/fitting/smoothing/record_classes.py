"""Classes of the records that tracking and smoothing store; files with other classes are not read."""

from __future__ import annotations

from kinefit._records import Codec
from kinefit.bodies import BodyState, PointSet
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.fitting.frame.results import FrameResult
from kinefit.geometry.losses import Loss
from kinefit.images.regions import Ratios, RegionColours
from kinefit.sensors.base import Leftover, RowsOf
from kinefit.sensors.displaced import Displaced, DisplacedMatched
from kinefit.sensors.points.body_trackers import BodyTrackerMatched, BodyTrackerMeasurement
from kinefit.sensors.points.image_lines import ImageLineMatched, ImageLineMeasurement
from kinefit.sensors.points.keypoints import KeypointMatched, KeypointMeasurement
from kinefit.sensors.points.lifted import LiftedMatched, LiftedMeasurement
from kinefit.sensors.points.markers import MarkerMatched, MarkerMeasurement
from kinefit.sensors.regions.region_parts import Coloured, Kept, Lines, Seams
from kinefit.sensors.regions.regions import RegionMatched, RegionMeasurement
from kinefit.sensors.regions.silhouette import SilhouetteMatched, SilhouetteMeasurement
from kinefit.sensors.surfaces.depth_image import DepthImageMatched, DepthImageMeasurement
from kinefit.sensors.surfaces.point_cloud import FreePairs, PointCloudMatched, PointCloudMeasurement, SurfacePairs
from kinefit.sensors.surfaces.surface_points import SurfacePointMatched, SurfacePointMeasurement
from kinefit.sensors.visibility.occlusion import Hidden
from kinefit.solving.correspondences.contours.rims import Rim

CODEC = Codec([
    BodyState, PointSet, SurfaceAnchors, Rim, FrameResult, Ratios, RegionColours, Loss, Leftover, RowsOf,
    DepthImageMatched, DepthImageMeasurement, Displaced, DisplacedMatched, ImageLineMatched, ImageLineMeasurement,
    KeypointMatched, KeypointMeasurement, LiftedMatched, LiftedMeasurement, MarkerMatched, MarkerMeasurement, Hidden,
    PointCloudMatched, PointCloudMeasurement, Coloured, Kept, RegionMatched, Lines, Seams, RegionMeasurement,
    SilhouetteMatched, SilhouetteMeasurement, FreePairs, SurfacePairs, SurfacePointMatched, SurfacePointMeasurement,
    BodyTrackerMatched, BodyTrackerMeasurement,
])  # fmt: skip
"""Writes and reads records of tracked frames, without what all frames share (bodies, sensors, cameras)."""
