"""The surface that is tracked, and which of its points each sensor sees.

Each segment is rendered by itself, so that at each pixel the foremost segment and the surface behind it are known. A
measurement supports a segment only if the rest of the body does not explain it: an arm that has slipped into the trunk
agrees with the trunk's surface, but no measurement requires it.

A tube that slides along its axis covers the same pixels, except at its ends. So a segment may agree with nearly all
measurements while its joint is elsewhere. The third of the segment next to the joint decides: if less than two thirds
of it are visible, the joint may be off by a ninth of the segment, 3 cm of a forearm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.limbs import knuckles, limbs, of_fingers
from kinefit.bodies.morphs.morphing import MorphedPose, Morphing
from kinefit.bodies.rendering import Canvas, scaled
from kinefit.bodies.surfaces import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh, sample
from kinefit.errors import BodyError
from kinefit.geometry.camera import Camera
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, BELIEVED, MIN_VISIBLE_OUTLINE, Evidence
from kinefit.sensors.visibility import _kernels_visibility as kernels
from kinefit.solving.correspondences.contours.outlines import RimFinder
from kinefit.solving.correspondences.occupancy.free_space import SurfaceSamples
from kinefit.solving.correspondences.targets import check_depth_image

RENDER_COLUMNS = 160  # of the rendered image: a person's forearm at 3 m is then four pixels wide
MIN_CONTOUR_PIXELS = 16  # of a whole segment: fewer are no evidence
MAX_HOLE = 0.03  # [m] to the next measurement: holes, hair, gaps between fingers and shadows at edges are narrower
MAX_BLANK_SHARE = 0.2  # of the body, if a blank pixel is to mean empty space: five to one against the body


@dataclass(frozen=True, eq=False)
class SegmentVerdict:
    """Pixels of a depth image that support or contradict each segment.

    Parameters
    ----------
    counts : (S, 6) int, pixels of each segment
        its whole rendered area; foremost, and supported by a measurement that no other segment explains; supported, but
        explained without it; empty: a measurement lies behind, or it is blank (no measurement within `MAX_HOLE`, by a
        sensor that measures nearly all of the body); covered: a measurement lies in front; unknown: no measurement, or
        fingers in free space, which may be folded.
    unseen : (S,) bool
        Segments whose joint is unobserved, even if the rest of them agrees; see `LimbEnds`.
    """

    counts: NDArray
    unseen: NDArray

    @property
    def supported(self) -> NDArray:
        """(S,) pixels that support a segment and no other."""
        return self.counts[:, kernels.UNIQUE]

    @property
    def seen(self) -> NDArray:
        """(S,) pixels that support a segment, contradict it, or agree with another as well."""
        return self.counts[:, [kernels.UNIQUE, kernels.SHARED, kernels.EMPTY]].sum(axis=1)

    @property
    def covered(self) -> NDArray:
        """(S,) share in 0..1 of a segment's foremost pixels that another object occludes."""
        return self.counts[:, kernels.COVERED] / np.maximum(self.counts[:, 1:].sum(axis=1), 1)

    @property
    def holds(self) -> NDArray:
        """(S,) bool: segments whose visible part agrees, wherever their joint is."""
        enough = self.supported >= MIN_VISIBLE_OUTLINE * np.maximum(self.counts[:, kernels.OWN], MIN_CONTOUR_PIXELS)
        return np.asarray(enough & (self.supported >= BELIEVED * self.seen))

    @property
    def evidence(self) -> Evidence:
        """Evidence in contours of each segment; none for one that agrees while its joint is unobserved."""
        against, whole = self.seen - self.supported, np.maximum(self.counts[:, kernels.OWN], MIN_CONTOUR_PIXELS)
        share = np.where(self.unseen & (self.supported >= against), 0.0, 1.0 / whole)
        return Evidence(share * self.supported, share * against, unplaced=self.unseen)


class Layers:
    """Buffers to render a body segment by segment, for one body and one size of image.

    Parameters
    ----------
    body : Body with surfaces
    camera : Camera of the depth images
    mesh : BodyMesh of the body, made where it is not given.
    """

    def __init__(self, body: Body, camera: Camera, *, mesh: BodyMesh | None = None) -> None:
        self.mesh = mesh = body_mesh(body) if mesh is None else mesh
        self.camera = scaled(camera, min(RENDER_COLUMNS / camera.size[0], 1.0))
        self.canvas = Canvas(self.camera.size)
        width, height = self.camera.size
        self.front, self.behind = np.empty((2, height, width), np.float32)
        self.owner = np.empty((height, width), np.int32)
        self.counts = np.empty((len(body.tree.segments), kernels.COUNTS), np.int64)
        self.measured = np.empty((height, width), np.uint8)
        self.limbs, self.ends = LimbEnds(body, mesh), np.empty((len(body.tree.segments), 2), np.int64)
        self._parts = [_part(mesh, s) for s in np.unique(mesh.segment)]

    def draw(self, vertices_world: NDArray) -> None:
        """Render the body's mesh (V, 3) [m]: `front`, `behind`, `owner`, and each segment's area in `counts`."""
        self.front.fill(np.inf)
        self.behind.fill(np.inf)
        self.counts.fill(0)
        for s, vertices, faces in self._parts:
            shown = self.canvas.draw_for(self.camera, vertices_world[vertices], faces, cull=True)
            flat = (image.reshape(-1) for image in (self.front, self.behind, self.owner))
            kernels.add_layer(shown.depth.reshape(-1), s, *flat, self.counts)


def _part(mesh: BodyMesh, segment: int) -> tuple[int, slice, NDArray]:
    """A segment's range of vertices, and its faces, indexed within the range (a mesh may interleave segments)."""
    own = np.flatnonzero(mesh.segment == segment)
    first, last = int(own[0]), int(own[-1]) + 1
    return int(segment), slice(first, last), np.ascontiguousarray(mesh.faces[mesh.face_segment == segment] - first)


def judge_segments(
    vertices_world: NDArray, layers: Layers, depth: NDArray, camera: Camera, *,
    noise: tuple[float, float] = (0.002, 0.002), slack: float = 0.015,
) -> SegmentVerdict:  # fmt: skip
    """Judge every segment of a body by one depth image.

    Parameters
    ----------
    vertices_world : (V, 3) [m] its mesh in the pose to be judged.
    layers : Layers of this body and camera; overwritten.
    depth : (H, W) [m]
        0 where nothing was measured; negative where it is known to belong to another object, see `Background`.
    noise : a [m] and b [1/m] of a depth's standard deviation a + b z².
    slack : float [m]
        Tolerated error of pose and shape, along the line of sight and across it.

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    check_depth_image(depth, camera)
    layers.draw(vertices_world)
    width, height = layers.camera.size
    cells = camera.size[0] / width, camera.size[1] / height
    kernels.measured(depth, *cells, layers.measured)
    away = cv2.distanceTransform(1 - layers.measured, cv2.DIST_L2, 3)
    axes = layers.limbs.axes(vertices_world, camera)
    layers.ends.fill(0)
    kernels.judge(
        layers.front, layers.behind, layers.owner, depth, away, *cells, camera.matrix[0, 0], slack, MAX_HOLE,
        AGREEMENT_SIGMAS * noise[0], AGREEMENT_SIGMAS * noise[1], camera.ray_table, axes, JOINT_END_SHARE,
        layers.counts, layers.ends,
    )  # fmt: skip
    counts = layers.counts[:, : kernels.BLANK].copy()
    blank = layers.counts[:, kernels.BLANK]
    few = blank.sum() <= MAX_BLANK_SHARE * layers.counts[:, 1:].sum()
    counts[:, kernels.EMPTY if few else kernels.UNKNOWN] += blank
    return SegmentVerdict(counts, layers.limbs.unseen(axes, layers.ends, camera))


JOINT_END_SHARE = 1.0 / 3.0  # of a segment's length, next to its joint
MIN_JOINT_END_VISIBLE = 2.0 / 3.0  # share of that end: with less a forearm may have slid along its axis by 3 cm
_JOINT_END_SAMPLES = 16  # points along the end
_MIN_JOINT_END_PIXELS = 16  # with fewer the segment is far away, or other parts of the body occlude it


class LimbEnds:
    """The axes of a body's segments, which decide whether the end at a joint is visible.

    Parameters
    ----------
    body : Body
    mesh : BodyMesh of it
    """

    def __init__(self, body: Body, mesh: BodyMesh) -> None:
        count = len(body.tree.segments)
        self.jointed = np.array([s for limb in limbs(body) for s in limb[1:]], int)
        own, self._of, first = [], [], [0]
        self.fingers = np.full(count, np.inf)
        at = knuckles(body)
        for s in np.unique(mesh.segment):
            index = np.flatnonzero(mesh.segment == s)
            x = mesh.vertices[index] - body.tree.rest[s]
            axis = x.mean(axis=0)
            t = x @ axis
            for end in (t <= t.min() + 0.01 * np.ptp(t), t >= t.max() - 0.01 * np.ptp(t)):
                own.append(index[end])
                first.append(first[-1] + int(end.sum()))
            self._of.append(int(s))
            if s in at and np.ptp(t) > 0.0:
                self.fingers[s] = (at[s] @ axis - t.min()) / np.ptp(t)
        self._index, self._first = np.concatenate(own), np.array(first[:-1])
        self._number, self._count = np.diff(first), count

    def axes(self, vertices_world: NDArray, camera: Camera) -> NDArray:
        """(S, 7) of each segment in the camera's frame: begin (3,) [m], axis (3,) [1/m], fingers' begin in 0..1."""
        ends = np.add.reduceat(vertices_world[self._index], self._first, axis=0) / self._number[:, None]
        ends = (ends @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]).reshape(-1, 2, 3)
        along = ends[:, 1] - ends[:, 0]
        out = np.zeros((self._count, 7))
        out[self._of, :3] = ends[:, 0]
        out[self._of, 3:6] = along / np.maximum(np.square(along).sum(axis=1, keepdims=True), 1e-12)
        out[:, 6] = self.fingers
        return out

    def unseen(self, axes: NDArray, counts: NDArray, camera: Camera) -> NDArray:
        """(S,) bool: segments of a limb whose end at the joint is too little visible.

        Parameters
        ----------
        axes : (S, 7) as `axes` gives them
        counts : (S, 2) of each segment's end: pixels where it is foremost, and those of them that agree
        camera : Camera
        """
        out, s = np.zeros(self._count, bool), self.jointed
        inside, (drawn, agreeing) = self._inside(axes[s], camera), counts[s].T
        whole = drawn / np.maximum(inside, 1.0 / _JOINT_END_SAMPLES)  # with the part outside the image
        out[s] = (inside == 0.0) | ((whole >= _MIN_JOINT_END_PIXELS) & (agreeing < MIN_JOINT_END_VISIBLE * whole))
        return out

    def _inside(self, axes: NDArray, camera: Camera) -> NDArray:
        """(N,) share of the ends' axes that lies within the image."""
        t = JOINT_END_SHARE * (np.arange(_JOINT_END_SAMPLES) + 0.5) / _JOINT_END_SAMPLES
        along = axes[:, 3:6] / np.maximum(np.square(axes[:, 3:6]).sum(axis=1, keepdims=True), 1e-12)
        x = axes[:, None, :3] + t[:, None] * along[:, None]
        K, (width, height) = camera.matrix, camera.size
        z = np.maximum(x[..., 2], 1e-6)
        u, v = K[0, 0] * x[..., 0] / z + K[0, 2], K[1, 1] * x[..., 1] / z + K[1, 2]
        shown = (x[..., 2] > 0.0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        return np.asarray(shown.mean(axis=1))


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
