"""Frozen correspondences of surface and measurements: valid at any state of any body with the same surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces import SurfaceAnchors
from kinefit.correspondences import anchored_rows, free_space_rows, target_rows
from kinefit.correspondences.anchored import anchored
from kinefit.correspondences.contours.morphed import on_moved_joints
from kinefit.correspondences.occupancy.depth_image import SurfaceSamples
from kinefit.correspondences.occupancy.free_space import FreeSpace
from kinefit.geometry.camera import Camera
from kinefit.losses import SQUARED, geman_mcclure
from kinefit.rows import DofRows, Rows
from kinefit.sensors.scene import Scene


@dataclass(frozen=True, eq=False)
class SurfacePairs:
    """N measured points with their corresponding points of the surface: point to plane (P2 2.3).

    Parameters
    ----------
    anchors : SurfaceAnchors
    x_world : (N, 3) [m] measured.
    weight : (N,) [1/m²]
    scale : float [m] of the loss (Geman-McClure): at this distance a pair has a quarter of its weight.
    at_surface : bool, see `anchored_rows`.
    camera : Camera that measured them, at the pose of `x_world`; they move with its pose in a scene's rig.
    """

    anchors: SurfaceAnchors
    x_world: NDArray
    weight: NDArray
    scale: float
    at_surface: bool
    camera: Camera | None = None

    @classmethod
    def nearest(
        cls, rows: Rows, x_world: NDArray, scene: Scene, scale: float, factor: float = 1.0,
        camera: Camera | None = None,
    ) -> SurfacePairs:  # fmt: skip
        """Pairs of measured points (M, 3) [m] and nearest points, from `surface_rows` at the scene's state.

        `scale` [m] is of the loss; `factor` multiplies the weights.
        """
        x, rest, normal = anchored(rows, x_world, scene.frames)
        anchors = SurfaceAnchors(scene.body, rows.segment, rest, normal)
        return cls(anchors, x, factor * rows.weight, scale, True, camera)

    @classmethod
    def seen(
        cls, rows: Rows, samples: SurfaceSamples, scene: Scene, scale: float, camera: Camera
    ) -> SurfacePairs:
        """Pairs of visible samples and their pixels' points, (M, 3) [m], from `depth_image_rows` at its state."""
        rest, normal = samples.point[:, rows.group].T, samples.normal[:, rows.group].T
        anchors = SurfaceAnchors(scene.body, rows.segment, np.ascontiguousarray(rest), np.ascontiguousarray(normal))
        return cls(anchors, np.ascontiguousarray(rows.point), rows.weight.copy(), scale, False, camera)

    def on_segments(self, scene: Scene) -> Rows:
        """The rows, ignoring joint centres that move with angles."""
        points, normals = self.anchors.on(scene.body)
        measured = self.x_world if self.camera is None else along(self.x_world, self.camera, scene)
        made = anchored_rows(
            scene.frames, self.anchors.segment, points, normals, measured, weight=self.weight,
            at_surface=self.at_surface,
        )  # fmt: skip
        return replace(made, loss=geman_mcclure(self.scale * np.sqrt(self.weight)))

    def rows(self, scene: Scene) -> Rows | DofRows:
        """One row a pair at a scene's state."""
        return _on_joints(scene, self.on_segments(scene))


@dataclass(frozen=True, eq=False)
class FreePairs:
    """Samples of the surface in free space, each with its target in the image.

    Parameters
    ----------
    anchors : SurfaceAnchors, N
    camera : Camera
    target : (N, 2) [px]
    slack, sigma : float [px] half a cell of free space; standard deviation
    """

    anchors: SurfaceAnchors
    camera: Camera
    target: NDArray
    slack: float
    sigma: float

    @classmethod
    def found(
        cls, scene: Scene, samples: SurfaceSamples, space: FreeSpace, camera: Camera, *, tolerance: float, sigma: float,
        seen: NDArray,
    ) -> FreePairs:  # fmt: skip
        """Find them with `free_space_rows` at a scene's state, without fingers that are folded.

        A hand counts as folded if more of its samples are in free space than in `seen`.

        Parameters
        ----------
        tolerance : float [m], sigma : float [px]
        seen : (M,) int, samples with a measurement at their pixels
        """
        chosen = np.empty(len(samples), np.int64)
        made = free_space_rows(
            scene.frames, samples, space, camera, tolerance=tolerance, sigma=sigma, chosen=chosen
        )
        hand = np.where(scene.surface.fingers, 1 + samples.segment, 0)
        air, there = (np.bincount(hand[some], minlength=1 + hand.max(initial=0)) for some in (made.group, seen))
        folded = air > there
        folded[0] = False
        own = made.group[~folded[hand[made.group]]]
        rest, normal = (np.ascontiguousarray(a[:, own].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[own], rest, normal)
        return cls(anchors, camera, space.middle(chosen[own]), 0.5 * space.cell, sigma)

    def rows(self, scene: Scene) -> Rows | DofRows:
        """One row a sample at a scene's state."""
        points, _ = self.anchors.on(scene.body)
        made = target_rows(
            scene.frames, self.anchors.segment, points, scene.placed(self.camera), self.target, slack=self.slack,
            sigma=self.sigma,
        )  # fmt: skip
        return _on_joints(scene, replace(made, loss=SQUARED))


def along(x_world: NDArray, camera: Camera, scene: Scene) -> NDArray:
    """(N, 3) [m] points that a camera measured, moved with its pose to the one in a scene's rig."""
    there = scene.placed(camera)
    if there is camera:
        return x_world
    T = there.T_world_camera @ camera.T_camera_world
    return np.ascontiguousarray(x_world @ T[:3, :3].T + T[:3, 3])


def _on_joints(scene: Scene, rows: Rows) -> Rows | DofRows:
    """Rows with the derivatives of joint centres that move with angles, if any do."""
    return rows if scene.morphing is None else on_moved_joints(scene.morphing.pose(scene.state), rows)
