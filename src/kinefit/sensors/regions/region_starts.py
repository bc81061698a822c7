"""Where else a body may be than where its contour was found: as a whole, a limb mirrored, a limb somewhere else."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.bodies.surfaces import segment_middles
from kinefit.geometry.camera import Camera
from kinefit.motion import BELIEVED
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_flips import Flips
from kinefit.sensors.regions.region_image import Coloured
from kinefit.sensors.regions.region_limbs import Limbs
from kinefit.sensors.regions.region_search import Seeker, region_starts
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings


class Starts:
    """What one sensor has of a body for its searches, and whose turn it is.

    Parameters
    ----------
    scene : Scene with the body
    label : (T,) part of the body that each face of its skin belongs to
    settings : TrackSettings
    searches : of limbs: number and time [s] of the last one, and the state of its random numbers; written in place
    """

    def __init__(self, scene: Scene, label: NDArray, settings: TrackSettings, searches: dict[str, Any]) -> None:
        self._body, self._mesh, self._label = scene.body, scene.surface.morphing.mesh, label
        self._jointed = len(scene.body.tree.segments) > 1
        self._settings, self._searches = settings, searches

    @cached_property
    def _seeker(self) -> Seeker:
        return Seeker(self._mesh.vertices, self._mesh.faces)

    @cached_property
    def _flips(self) -> Flips:
        tree, mesh = self._body.tree, self._mesh
        return Flips(self._body, segment_middles(mesh.vertices, mesh.segment, len(tree.segments)) - tree.rest)

    @cached_property
    def _limbs(self) -> Limbs:
        return Limbs(self._body, self._mesh, self._label, self._searches.get("random"))

    def whole(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray | None, told: Evidence
    ) -> list[BodyState]:
        """Of the body as a whole; see `region_starts`."""
        return region_starts(
            scene, camera, self._seeker, seen, information, told, self._settings.regions.search,
            rigid=not self._jointed,
        )  # fmt: skip

    def limbs(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray, told: Evidence, found: BodyState,
        time: float,
    ) -> list[BodyState]:  # fmt: skip
        """Of limbs, at most every `TrackSettings.search_every`: some mirrored, and one sought, which is lost if any is.

        Parameters
        ----------
        found : the state that was found, of which `told` says how it agrees
        """
        limbs, flips, s, last = self._limbs, self._flips, self._settings, self._searches
        if not limbs.segments or abs(time - last.get("time", -np.inf)) < s.search_every - 1e-6:
            return []
        last["time"], last["number"] = time, last.get("number", 0) + 1
        poor = [k for k, limb in enumerate(limbs.segments) if (told.quality[limb] < BELIEVED).any()]
        turns = poor or range(len(limbs.segments))
        limb = turns[last["number"] % len(turns)]
        near = flips.near(scene.state, information, found, camera)[: s.regions.flips]
        sought = limbs.sought(limb, found, list(flips.of(found, camera)), seen, camera)
        last["random"] = limbs.random.bit_generator.state
        leapt = [sought] if np.abs(sought.angles - found.angles).max() > 0.0 else []
        return [*near, *leapt, *flips.untwisted(found, limbs.segments[limb])]
