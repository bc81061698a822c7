"""A body's surface for tracking, made once: samples, a mesh, and render buffers."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.limbs import of_fingers
from kinefit.bodies.morphs.morphing import MorphedPose, Morphing
from kinefit.bodies.surfaces import BodyMesh, body_mesh, sample
from kinefit.correspondences.contours.rims import RimFinder
from kinefit.correspondences.occupancy.depth_image import SurfaceSamples
from kinefit.errors import BodyError
from kinefit.geometry.camera import Camera
from kinefit.rendering import Canvas, scaled
from kinefit.sensors.visibility.visibility import Layers

_RENDER_COLUMNS = 160  # of the image that finds self-occlusions: a forearm at 3 m is four pixels wide


class TrackedSurface:
    """A body's surface, for one tracker at a time.

    Parameters
    ----------
    body : Body with surfaces
    count : int, samples of its surface.

    Attributes
    ----------
    mesh : BodyMesh of its simple surfaces, for depth
    morphing : Morphing, its skin (the mesh, where it has none) with its morphs, for contours
    judged : the state that was last rendered segment by segment, in all cameras

    Raises
    ------
    BodyError
        A body without surfaces.
    """

    def __init__(self, body: Body, count: int) -> None:
        if not body.surfaces:
            remedy = "Depth needs surfaces: add them as in bodies of the catalogue, or use one of those."
            raise BodyError(f"body '{body.name}' has no surfaces", remedy=remedy)
        self.body, self.count, self.morphing = body, count, Morphing(body)
        self.mesh = self.morphing.mesh if isinstance(self.morphing.mesh, BodyMesh) else body_mesh(body)
        self.judged: BodyState | None = None
        self._posed: tuple[BodyState, NDArray] | None = None
        self._pose: MorphedPose | None = None
        self._canvases: dict[Camera, Canvas] = {}
        self._rims: dict[Camera, RimFinder] = {}
        self._layers: dict[Camera, Layers] = {}

    def with_shape(self, morphing: Morphing) -> TrackedSurface:
        """The same body with another skin, such as a low-pass approximation of its own."""
        out = TrackedSurface(self.body, self.count)
        out.morphing = morphing
        return out

    @cached_property
    def samples(self) -> SurfaceSamples:
        """Points spread over the whole surface."""
        points, normals, segment = sample(self.body, self.count)
        return SurfaceSamples(segment, points.T, normals.T)

    @cached_property
    def fingers(self) -> NDArray:
        """(N,) bool: samples of fingers, which are elsewhere while the hand is a fist."""
        return of_fingers(self.body, self.samples.segment, self.samples.point.T)

    @cached_property
    def areas(self) -> NDArray:
        """(S,) [m²] of each segment."""
        corners = self.mesh.vertices[self.mesh.faces]
        twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        return np.asarray(0.5 * np.bincount(self.mesh.face_segment, twice, len(self.body.tree.segments)))

    def posed(self, state: BodyState) -> NDArray:
        """(V, 3) [m] its mesh in the world; cached for the latest state."""
        if self.mesh is self.morphing.mesh:
            return self.pose(state).vertices
        if self._posed is None or self._posed[0] is not state:
            if self.morphing.moves_joints:
                frames = self.morphing.pose(state).frames
            else:
                frames = self.body.tree.forward(state.T_world_root, state.angles)[0]
            self._posed = state, self.mesh.posed(frames)
        return self._posed[1]

    def pose(self, state: BodyState) -> MorphedPose:
        """Its morphed skin in the world; cached for the latest state."""
        if self._pose is None or self._pose.state is not state:
            pose = self.morphing.pose(state)
            assert pose.vertices is not None  # computed now, before several threads ask for it
            self._pose = pose
        return self._pose

    def depth(self, vertices_world: NDArray, camera: Camera) -> NDArray:
        """(h, w) [m] its rendered depth in a camera, downsampled, inf where there is no body; vertices (V, 3).

        The next call for this camera overwrites it.
        """
        small = scaled(camera, min(_RENDER_COLUMNS / camera.size[0], 1.0))
        if camera not in self._canvases:
            self._canvases[camera] = Canvas(small.size)
        return self._canvases[camera].draw_for(small, vertices_world, self.mesh.faces, cull=True).depth

    def rims(self, camera: Camera) -> RimFinder:
        """The finder of its occluding contour in one camera, with its own buffers."""
        if camera not in self._rims:
            self._rims[camera] = RimFinder(self.morphing.mesh, next(iter(self._rims.values()), None))
        return self._rims[camera]

    def layers(self, camera: Camera) -> Layers:
        """Buffers to render it segment by segment."""
        if camera not in self._layers:
            self._layers[camera] = Layers(self.body, camera, mesh=self.mesh)
        return self._layers[camera]
