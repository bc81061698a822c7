"""Contour to contour: rim points of the body towards the contour of its silhouette (P1 2.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.lines import line_along
from kinefit.solving.correspondences import _kernels
from kinefit.solving.correspondences.contours import _kernels_outlines as kernels
from kinefit.solving.correspondences.contours.rims import Rim
from kinefit.solving.rows import Rows


def outline_pairs(
    rim: NDArray, image: NDArray, *, reach: float, angle: float = 1.0, both: bool = True
) -> tuple[NDArray, NDArray]:
    """Match two contours (4, N) and (4, M): indices (K,) of the points in the first and in the second.

    Each point of the body's rim is matched to the nearest point of the image's contour with a similar normal. With
    `both`, each point of the image's contour is matched to the rim too, which pulls the body to unexplained parts of
    the silhouette.

    Parameters
    ----------
    rim : (4, N) u, v [px] and unit normal of the body's contour.
    image : (4, M) the same of the silhouette's contour.
    reach : float [px], largest distance of a pair.
    angle : float [rad], largest angle between two normals.
    both : bool
    """
    to_image = np.empty(rim.shape[1], np.int64)
    to_model = np.empty((2, image.shape[1]))
    kernels.match(rim, image, reach, np.cos(angle), to_image, to_model)
    first = np.flatnonzero(to_image >= 0)
    pairs = [(first, to_image[first])]
    if both:
        second = np.flatnonzero(to_model[0] >= 0)
        pairs.append((to_model[0, second].astype(np.int64), second))
    i, k = (np.concatenate(side) for side in zip(*pairs))
    return i, k


def outline_rows(
    body: Body,
    state: BodyState,
    rim: Rim,
    vertices_world: NDArray,
    camera: Camera,
    image: NDArray,
    *,
    sigma: float = 2.0,
    by: str = "pixels",
) -> Rows:
    """Rows that pull the rim of a body onto the contour of its silhouette.

    By "pixels", one row for each pair: the rim point's pixel should lie on the tangent of the contour, along which it
    may slide. By "rays", two rows for each pair: the rim point should lie on the ray of the contour's point (P1's
    constraint). The `group` of a row is the index of its pair. `outline_pairs` finds pairs.

    Parameters
    ----------
    rim : Rim of the body at this state in this camera, N points.
    vertices_world : (V, 3) [m] of the mesh at this state.
    camera : Camera, of the image's size.
    image : (4, N) the matched point of the silhouette's contour for each: u, v [px], normal.
    sigma : float [px] standard deviation of a pair.
    by : "pixels" or "rays"

    Raises
    ------
    ObservationError
        Another `by`, or a sigma that is not positive.
    """
    if by not in ("pixels", "rays"):
        raise ObservationError(f"rows by '{by}'", remedy='Write by="pixels" or by="rays".')
    if not sigma > 0:
        raise ObservationError(f"a standard deviation of {sigma} px", remedy="Give a positive number of pixels.")
    count = len(rim)
    data, segment, group = _kernels.buffers(2 * count)
    if by == "pixels":
        used = kernels.tangent_rows(
            camera.packed, np.ascontiguousarray(vertices_world), rim.vertices, rim.share, rim.segment,
            np.ascontiguousarray(image), 1.0 / sigma**2, data, segment, group,
        )  # fmt: skip
        return Rows(np.ascontiguousarray(data[:, :used]), segment[:used], group[:used])
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    f, points = frames[rim.segment], rim.on(vertices_world)
    rest = np.ascontiguousarray(np.einsum("nij,ni->nj", f[:, :9].reshape(-1, 3, 3), points - f[:, 9:]))
    rays = line_along(camera.centre_world, camera.ray(image[:2].T))
    focal = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    depth = points @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    weight = np.where(depth > 0.0, (focal / (depth * sigma)) ** 2, 0.0)
    used = _kernels.ray_rows(frames, rim.segment, rest, rays, weight, data, segment, group, 0)
    return Rows(np.ascontiguousarray(data[:, :used]), segment[:used], group[:used])
