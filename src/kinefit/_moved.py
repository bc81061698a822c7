"""Modules by the paths that they had in version 0.2: each is found and warns; version 0.4 forgets them."""

from __future__ import annotations

import warnings
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED_PATHS = {
    "app": "studio.app", "app.served": "studio.app.review", "app.texts": "studio.app.pages.shell",
    "app.webcams": "studio.app.live", "assets": "readers.assets", "batch": "takes.batch",
    "batch.cluster": "takes.batch.processes", "batch.viewed": "studio.viewers.viewed",
    "bodies.anny": "bodies.morphs.anny", "bodies.body_surfaces": "bodies.surfaces.places",
    "bodies.closures": "bodies.tree", "bodies.joint_names": "bodies.toml.joint_names",
    "bodies.surfaces.places.meshes": "bodies.surfaces.places.anchors",
    "bodies.surfaces.places.nearest": "bodies.surfaces.places.anchors",
    "bodies.surfaces.triangles": "bodies.surfaces.mesh", "calibration": "rigs",
    "correspondences": "solving.correspondences", "diagnostics": "rigs.diagnostics",
    "diagnostics.sensors": "sensors.alignment", "diagnostics.views": "fitting.multiview.views",
    "evaluation": "simulation.evaluation", "exporters.gait.forces": "exporters.gait.files",
    "exporters.gait.page": "exporters.gait.files", "exporters.movements.course": "exporters.movements",
    "exporters.movements.found": "exporters.movements", "exporters.report.flagged": "exporters.report.report",
    "fitting.frame.minimum": "fitting.frame.fit", "fitting.frame.trust": "fitting.frame.results",
    "fitting.initialization.from_clicks": "fitting.initialization.from_points",
    "fitting.initialization.from_silhouettes": "fitting.initialization.candidates",
    "fitting.markers.poses": "fitting.markers.subject", "fitting.multiview.boxes": "fitting.multiview.association",
    "fitting.multiview.mirrors": "fitting.multiview.followed", "fitting.multiview.turned": "fitting.multiview.views",
    "fitting.smoothing.online.lag_frame": "fitting.smoothing.online.fixed_lag",
    "fitting.smoothing.record_classes": "fitting.smoothing.spool",
    "fitting.smoothing.shape_errors": "fitting.smoothing.border",
    "fitting.smoothing.windows": "fitting.smoothing.border", "fitting.subject.depth": "fitting.subject.surfaces",
    "fitting.subject.gear": "fitting.subject.parameters", "fitting.subject.matched_frames": "fitting.subject.fit",
    "fitting.subject.sensor_parameters": "fitting.subject.subject",
    "fitting.subject.view_bias": "fitting.subject.keypoints",
    "fitting.tracking.checkpoints.frame_file": "fitting.tracking.checkpoints.checkpoint",
    "fitting.tracking.marker_steps": "fitting.tracking.run", "fitting.tracking.markers": "fitting.tracking.video",
    "fitting.tracking.placing": "fitting.tracking.cameras", "fitting.tracking.session": "fitting.tracking.motions",
    "frame": "fitting.frame", "identification": "markers", "images.detectors.looking": "images.detectors.detection",
    "images.photogrammetry.flat": "images.photogrammetry.surface",
    "images.photogrammetry.matching.noise_correlation": "images.photogrammetry.least_squares_matching",
    "images.photogrammetry.points": "images.photogrammetry",
    "images.photogrammetry.points.one_camera": "images.photogrammetry.intersection",
    "images.photogrammetry.region_growing": "images.photogrammetry.least_squares_matching",
    "images.photogrammetry.states": "images.photogrammetry.surface", "initialization": "fitting.initialization",
    "lasting_errors": "bodies.lasting_errors", "live": "studio.live", "losses": "geometry.losses",
    "markers.audit.gaps": "markers.audit.swaps", "markers.audit.resting": "markers.audit.audit",
    "markers.first_set": "fitting.markers.first_set", "markers.frame.beliefs": "markers.frame.tables",
    "markers.frame.polish": "markers.frame.explain", "markers.model.gate": "markers.model.learn",
    "markers.poses": "fitting.markers.subject", "markers.sides": "fitting.markers.sides",
    "markers.subject": "fitting.markers.subject", "markers.take.votes": "markers.take.naming",
    "motion": "bodies.motion", "multiview": "fitting.multiview", "photogrammetry": "images.photogrammetry",
    "preparing": "takes.preparing", "preparing.ingest": "takes.preparing.take",
    "readers.annotations": "readers.landmarks.annotations",
    "readers.calibration.colmap": "readers.calibration.programs",
    "readers.calibration.matlab": "readers.calibration.programs",
    "readers.calibration.mocap": "readers.calibration.programs", "readers.detections": "readers.landmarks.detections",
    "readers.guess.depth_cameras": "readers.guess.cameras", "readers.keypoint_sets": "readers.landmarks.keypoint_sets",
    "readers.keypoints": "readers.landmarks.keypoints", "readers.landmarks.named": "readers.landmarks.results",
    "readers.skeletons.gltf": "readers.skeletons.characters", "readers.sound": "readers.videos.sound",
    "readers.take.clicks": "readers.take.points", "readers.take.skin": "readers.take.points",
    "readers.video": "readers.videos.video", "readers.video_files": "readers.videos.video_files", "recipes": "papers",
    "rendering": "bodies.rendering", "rigs.bar.placing": "rigs.bar.start", "rigs.bar.report": "rigs.bar.calibrate",
    "rigs.bar.table": "rigs.bar.targets", "rigs.board.intrinsics": "rigs.board.extrinsics",
    "rigs.diagnostics.depth": "rigs.diagnostics.person", "rigs.diagnostics.frozen": "rigs.diagnostics.images",
    "rigs.people.first_rig": "rigs.people.calibrate", "rigs.people.floor": "rigs.people.calibrate",
    "rigs.refine.sightings": "rigs.refine.result", "rows": "solving.rows",
    "sensors.kinds.trackers": "sensors.kinds.poses", "serving": "studio.serving",
    "simulation.replay": "simulation.figures", "smoothing": "fitting.smoothing", "solvers": "solving",
    "solvers.sequence": "solving.trajectory.sequence", "solving.bundle.body_bundle": "solving.bundle.shape",
    "solving.correspondences.anchored": "solving.correspondences.surfaces",
    "solving.correspondences.bands": "solving.correspondences.closures",
    "solving.correspondences.contours.morphed": "solving.correspondences.contours.outlines",
    "solving.correspondences.contours.rims": "solving.correspondences.contours.outlines",
    "solving.correspondences.occupancy.collisions": "solving.correspondences.occupancy.free_space",
    "solving.correspondences.occupancy.depth_image": "solving.correspondences.occupancy.free_space",
    "solving.pixels": "solving.least_squares", "solving.rigid_clusters": "solving.functional_joints",
    "solving.trajectory.marginal": "solving.trajectory.smoothing",
    "solving.trajectory.seen_points": "solving.trajectory.sequence", "subject": "fitting.subject",
    "takes.preparing.each_video": "takes.preparing.detecting", "tracking": "fitting.tracking",
    "viewers": "studio.viewers",
}  # fmt: skip
"""{path below `kinefit` in 0.2 or since: path now}; what lies below a path moved with it."""


def moved(old: str) -> str:
    """Where a module with this dotted name of version 0.2 is now; empty if it is no such name."""
    parts = old.split(".")[1:]
    for count in range(len(parts), 0, -1):
        if new := MOVED_PATHS.get(".".join(parts[:count])):
            return ".".join(["kinefit", new, *parts[count:]])
    return ""


class MovedFinder(MetaPathFinder, Loader):
    """Import the module of the new path where the old one is asked for: one module under both names."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """The specification of a moved module; None for all others."""
        is_moved = fullname.startswith("kinefit.") and moved(fullname)
        return ModuleSpec(fullname, self, loader_state=[]) if is_moved else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module of the new path."""
        new = moved(spec.name)
        warnings.warn(f"{spec.name} is {new} now; the old path ends with 0.4", DeprecationWarning, stacklevel=2)
        module = import_module(new)
        spec.loader_state.append(module.__spec__)
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is run again; the module stays what it is under its new name."""
        spec = module.__spec__
        assert spec is not None and spec.loader_state
        module.__spec__ = spec.loader_state[0]
