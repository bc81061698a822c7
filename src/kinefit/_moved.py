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
    "bodies.joint_names": "bodies.toml.joint_names", "calibration": "rigs",
    "correspondences": "solving.correspondences", "diagnostics": "rigs.diagnostics",
    "diagnostics.sensors": "sensors.alignment", "diagnostics.views": "fitting.multiview.views",
    "evaluation": "simulation.evaluation", "frame": "fitting.frame", "identification": "markers",
    "initialization": "fitting.initialization", "lasting_errors": "bodies.lasting_errors", "live": "studio.live",
    "losses": "geometry.losses", "markers.first_set": "fitting.markers.first_set",
    "markers.poses": "fitting.markers.poses", "markers.sides": "fitting.markers.sides",
    "markers.subject": "fitting.markers.subject", "motion": "bodies.motion", "multiview": "fitting.multiview",
    "photogrammetry": "images.photogrammetry", "preparing": "takes.preparing",
    "preparing.ingest": "takes.preparing.take",
    "readers.annotations": "readers.landmarks.annotations", "readers.detections": "readers.landmarks.detections",
    "readers.guess.depth_cameras": "readers.guess.cameras",
    "readers.keypoint_sets": "readers.landmarks.keypoint_sets", "readers.keypoints": "readers.landmarks.keypoints",
    "readers.sound": "readers.videos.sound", "readers.take.clicks": "readers.take.points",
    "readers.take.skin": "readers.take.points", "readers.video": "readers.videos.video",
    "readers.video_files": "readers.videos.video_files", "recipes": "papers", "rendering": "bodies.rendering",
    "rows": "solving.rows", "serving": "studio.serving", "smoothing": "fitting.smoothing", "solvers": "solving",
    "solvers.sequence": "solving.trajectory.sequence", "subject": "fitting.subject", "tracking": "fitting.tracking",
    "viewers": "studio.viewers",
}  # fmt: skip
"""{path below `kinefit` in 0.2: path now}; what lies below a path moved with it."""


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
