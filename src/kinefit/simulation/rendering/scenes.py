"""A moving body in a room, and its rendering in a camera: segment, depth and surface point of every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.triangles import BodyMesh, body_mesh
from kinefit.geometry.camera import Camera
from kinefit.motion import Motion
from kinefit.rendering import Canvas, Raster
from kinefit.simulation.rendering.room import Room, room


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One frame of a scene in one camera.

    Parameters
    ----------
    raster : Raster
        `segment` is the segment of the body, or the number of segments plus the part of the room.
    camera : Camera
    vertices : (V, 3) [m] of all triangles, in the world
    faces : (T, 3) int
    frames : (S, 12) poses of the segments, from `KinematicTree.forward`
    """

    raster: Raster
    camera: Camera
    vertices: NDArray
    faces: NDArray
    frames: NDArray

    @cached_property
    def normals(self) -> NDArray:
        """(T + 1, 3) unit normals of the triangles in the world; the last, for empty pixels, is zero."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return np.append(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), [[0.0] * 3], 0)

    @cached_property
    def x_camera(self) -> NDArray:
        """(H, W, 3) [m] surface point of each pixel in the camera's frame; not finite for empty pixels."""
        a, b = self.camera.ray_table
        return np.stack([a, b, np.ones_like(a)], axis=-1) * self.raster.depth[..., None]

    @cached_property
    def cosine(self) -> NDArray:
        """(H, W) cosine between the surface's normal and the ray; 0 for empty pixels."""
        a, b = self.camera.ray_table
        rays = np.stack([a, b, np.ones_like(a)], axis=-1) / np.sqrt(a * a + b * b + 1.0)[..., None]
        normals = (self.normals @ self.camera.T_camera_world[:3, :3].T)[self.raster.face]
        return np.abs(np.einsum("hwk,hwk->hw", normals, rays))

    @cached_property
    def x_rest(self) -> NDArray:
        """(H, W, 3) [m] surface point of each pixel in the body's rest pose (root frame); room points in the world.

        A point of a surface has the same x_rest in all cameras and frames. Empty pixels have zero.
        """
        R, t = self.camera.T_camera_world[:3, :3], self.camera.T_camera_world[:3, 3]
        out = (np.where(self.raster.seen[..., None], self.x_camera, 0.0) - t) @ R
        segment = self.raster.segment
        body = (segment >= 0) & (segment < len(self.frames))
        f = self.frames[segment[body]]
        out[body] = np.einsum("nj,njk->nk", out[body] - f[:, 9:], f[:, :9].reshape(-1, 3, 3))
        out[~self.raster.seen] = 0.0
        return out


@dataclass(frozen=True, eq=False)
class SimulatedScene:
    """A known motion, the triangles of its body, and the room around it.

    Parameters
    ----------
    motion : Motion
    mesh : BodyMesh
    room : Room or None
    """

    motion: Motion
    mesh: BodyMesh
    room: Room | None = None

    @classmethod
    def of(cls, motion: Motion, camera: Camera | None = None) -> SimulatedScene:
        """Scene of a motion; with a room around it if a camera is given, which looks into the room."""
        return cls(motion, body_mesh(motion.body), None if camera is None else room(motion, camera))

    @cached_property
    def faces(self) -> NDArray:
        """(T, 3) int32 triangles of the body, then of the room."""
        parts = [np.asarray(self.mesh.faces)]
        if self.room is not None:
            count = len(self.mesh.vertices)
            parts.append(self.room.faces + count)
        return np.ascontiguousarray(np.concatenate(parts), np.int32)

    @cached_property
    def labels(self) -> NDArray:
        """(T,) int, segment of every triangle; the number of segments plus the part for triangles of the room."""
        parts = [np.asarray(self.mesh.face_segment)]
        if self.room is not None:
            parts.append(self.room.parts + len(self.motion.body.tree.segments))
        return np.concatenate(parts)

    def view(self, frame: int, camera: Camera) -> RenderedView:
        """Render a frame of the motion in a camera, without errors."""
        state = self.motion.state(frame)
        frames, _ = self.motion.body.tree.forward(state.T_world_root, state.angles)
        vertices = self.mesh.posed(frames)
        if self.room is not None:
            vertices = np.concatenate([vertices, self.room.vertices])
        raster = Canvas(camera.size).draw_for(camera, vertices, self.faces, cull=True, labels=self.labels)
        return RenderedView(raster, camera, vertices, self.faces, frames)


def centred_camera(
    name: str, size: tuple[int, int], focal: float, T_camera_world: NDArray | None = None
) -> Camera:
    """A camera without distortion whose principal point is the centre of its image.

    Parameters
    ----------
    size : (width, height) [px]
    focal : float [px]
    T_camera_world : (4, 4) [m], default: the identity
    """
    K = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
    return Camera(name, size, K, (), "radtan", T_camera_world)  # type: ignore[arg-type]
