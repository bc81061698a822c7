"""Drawing on images: bones seen by a camera, keypoints, writing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, Morphing, PointSet
from kinefit.bodies.limbs import finger_groups
from kinefit.bodies.motion import OUTLIER_WEIGHT, Motion, Residuals
from kinefit.bodies.rendering import Canvas, looks
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.geometry.camera import Camera, ImageFrame

DARK, WHITE = (15, 15, 15), (255, 255, 255)
MEASURED, OUTLIER, WAY = (255, 240, 60), (255, 40, 40), (255, 90, 220)
_SAMPLES = np.linspace(0.0, 1.0, 6)[:, None]  # along a bone, which a lens may bend
_LIMB_WIDTH, _FINGER_WIDTH = 0.022, 0.007  # [m] of a bone as drawn
_SUBPIXEL_BITS, _MAX_DRAWN_PX = 4, 20000.0  # OpenCV's sub-pixel bits; [px] beyond which nothing is drawn
_BLOCKS = 4  # over the head: a face is known down to about ten
_ALL_BLOCKS = 12  # over the longer side of a picture that shows faces one knows not where
_SKIN_OPACITY = 0.75
_TO_LIGHT = np.array([-0.36, -0.48, -0.8])  # in the camera's frame
_DASH_WIDTHS = 3.0  # length of a dash, and of a gap, over the width of its line: its ends are round


@lru_cache(maxsize=8)
def bones(body: Body) -> tuple[PointSet, tuple[int, ...], tuple[tuple[int, int, int], ...], NDArray]:
    """Bones of a body: points (2 B) (from, to, from, to ...), owners (B,), colours (B,), widths (B,) [m] as drawn.

    From every joint to the joints of its children; from the last joint of a limb to the end of its surface.
    """
    tree, ends = body.tree, body.segment_ends()
    owners, points, colours, widths = [], [], [], []
    fingers = {name for own in finger_groups(body).values() for name in own}
    for s, name in enumerate(tree.segments):
        children = np.flatnonzero(tree.parents == s)
        tips = [(tree.offsets[c], tree.segments[c]) for c in children]
        if not tips and s in ends:
            tips = [(ends[s], name)]
        for tip, side in tips:
            owners.append(s)
            points += [np.zeros(3), tip]
            colours.append(looks.side_colour(side))
            widths.append(_FINGER_WIDTH if side in fingers else _LIMB_WIDTH)
    names = tuple(f"{tree.segments[s]}_{k}" for s in owners for k in (0, 1))
    return PointSet(names, np.repeat(owners, 2), np.array(points)), tuple(owners), tuple(colours), np.array(widths)


def draw_bones(image: NDArray, motion: Motion, frame: int, camera: Camera, image_frame: ImageFrame) -> None:
    """Draw the fitted skeleton into an image (H, W, 3) uint8 RGB, far bones first; lost ones are thin, grey, dashed."""
    points, owners, colours, widths = bones(motion.body)
    ends = motion.body.positions(motion.state(frame), points).reshape(-1, 2, 3)
    lines = ends[:, :1] * (1 - _SAMPLES) + ends[:, 1:] * _SAMPLES  # (B, samples, 3)
    uv = image_frame.from_calibration(camera.project(lines))
    depth = ends.mean(1) @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    px_per_metre = camera.matrix[0, 0] * float(np.mean(image_frame.scale)) / np.maximum(depth, 1e-3)
    thick = np.clip(np.rint(widths * px_per_metre), 2, 24).astype(int)
    edge = max(1, round(image.shape[0] / 900))
    for b in np.argsort(-depth):
        lost = motion.lost[frame, owners[b]]
        width = max(1, int(thick[b]) // 3) if lost else int(thick[b])
        dash = _DASH_WIDTHS * (width + 2 * edge) if lost else 0.0
        draw_line(image, uv[b], DARK, width + 2 * edge, dash)
        draw_line(image, uv[b], looks.LOST_COLOUR if lost else colours[b], width, dash)
    for b in np.flatnonzero(~motion.lost[frame, list(owners)]):
        draw_dot(image, uv[b, 0], 0.36 * thick[b], WHITE, -1)


@lru_cache(maxsize=8)
def _skin(body: Body) -> tuple[looks.TubeMesh, NDArray]:
    """The skin as viewer and report show it, and the segment of each triangle."""
    mesh = looks.body_mesh(body)
    return mesh, looks.triangle_segments(mesh)


def draw_skin(image: NDArray, motion: Motion, frame: int, camera: Camera, image_frame: ImageFrame) -> None:
    """Lay the shaded skin over an image (H, W, 3) uint8 RGB; lost parts are grey, uncertain ones more translucent."""
    (mesh, owners), tree = _skin(motion.body), motion.body.tree
    if not len(owners):
        return
    Ts = tree.segment_poses(motion.Ts_world_root[frame][None], motion.angles[frame][None])[0][:, :3].copy()
    Ts[..., 3] -= np.einsum("sij,sj->si", Ts[..., :3], tree.rest)  # from the root's frame at rest
    followed = np.einsum("vk,vkij->vij", mesh.weights, Ts[mesh.segments])
    vertices = np.einsum("vij,vj->vi", followed[..., :3], mesh.vertices) + followed[..., 3]
    normals = np.einsum("vij,vj->vi", followed[..., :3], mesh.normals)[mesh.triangles].mean(axis=1)
    light = 0.5 + 0.6 * np.maximum(normals @ (camera.T_camera_world[:3, :3].T @ _TO_LIGHT), 0.0)
    colours, opacities = looks.segment_looks(
        motion.segment_quality[frame], looks.side_colours(motion.body), by_quality=False,
        uncertain=looks.uncertain_segments(motion.body, motion.joint_std[frame]),
    )  # fmt: skip
    shades = np.column_stack([np.minimum(colours[owners] * light[:, None], 255.0), np.full(len(owners), 255.0)])
    shades *= _SKIN_OPACITY * opacities[owners][:, None]
    face = Canvas(camera.size).draw_for(camera, vertices, mesh.triangles, cull=True).face
    layer = np.zeros((*face.shape, 4), np.uint8)
    layer[face >= 0] = shades.astype(np.uint8)[face[face >= 0]]
    layer = cv2.warpAffine(layer, image_frame.T_image_calibration[:2], image.shape[1::-1])
    rows, columns = layer[..., 3].any(axis=1).nonzero()[0], layer[..., 3].any(axis=0).nonzero()[0]
    if len(rows):
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        image[box] = image[box] * (1.0 - layer[box][..., 3:] / 255.0) + layer[box][..., :3]


@lru_cache(maxsize=8)
def _outlined(body: Body) -> Morphing | None:
    """What draws the outline of a body with a skin or a mesh; None for one of simple shapes."""
    return Morphing(body) if body.skin or any(isinstance(s, MeshSurface) for s in body.surfaces) else None


def draw_body(image: NDArray, motion: Motion, frame: int, camera: Camera, image_frame: ImageFrame) -> None:
    """Draw the fitted body into an image (H, W, 3) uint8 RGB: its bones, and the outlines of a skin or of meshes."""
    outlined, segments = _outlined(motion.body), motion.body.tree.segments
    if outlined is None or len(segments) > 1:
        draw_bones(image, motion, frame, camera, image_frame)
    if outlined is None:
        return
    mesh, vertices = outlined.mesh, outlined.pose(motion.state(frame)).vertices
    drawn = Canvas(camera.size).draw_for(camera, vertices, mesh.faces, cull=True, labels=mesh.face_segment).segment
    edge, lost = max(1, round(image.shape[0] / 480)), motion.lost[frame]
    for s in np.unique(drawn[drawn >= 0]):
        for contour in segment_contours(drawn, s):
            uv = image_frame.from_calibration(contour)
            dash = _DASH_WIDTHS * 3 * edge if lost[s] else 0.0
            draw_line(image, uv, DARK, 3 * edge, dash)
            draw_line(image, uv, looks.LOST_COLOUR if lost[s] else looks.side_colour(segments[s]), edge, dash)


def segment_contours(segments: NDArray, segment: int) -> list[NDArray]:
    """Closed contours (N, 2) [px] of one segment in an image (H, W) of segments."""
    contours, _ = cv2.findContours((segments == segment).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [np.vstack([contour[:, 0], contour[:1, 0]]).astype(float) for contour in contours]


def drawn_points(motion: Motion, frame: int) -> NDArray:
    """(N, 3) [m] in the world what `draw_body` fills: ends of bones, and nodes of a skin or of meshes."""
    state, outlined = motion.state(frame), _outlined(motion.body)
    ends = motion.body.positions(state, bones(motion.body)[0])
    return ends if outlined is None else np.vstack([ends, outlined.pose(state).vertices])


def draw_residuals(image: NDArray, residuals: Residuals, frame: int, image_frame: ImageFrame) -> None:
    """Draw measured keypoints (rings; red crosses where they were left out) and the way to the fitted ones."""
    measured = image_frame.from_calibration(residuals.measured[frame])
    fitted = image_frame.from_calibration(residuals.measured[frame] - residuals.values[frame])
    size = max(2.5, image.shape[0] / 320)
    thin = max(1, round(size / 3))
    for k in np.flatnonzero(np.isfinite(measured).all(-1)):
        outlier = residuals.weights[frame, k] < OUTLIER_WEIGHT
        if np.isfinite(fitted[k]).all() and not outlier:
            draw_line(image, np.stack([measured[k], fitted[k]]), WAY, thin)
        if outlier:
            for way in ((1, 1), (1, -1)):
                step = size * np.array(way)
                draw_line(image, np.stack([measured[k] - step, measured[k] + step]), DARK, thin + 2)
                draw_line(image, np.stack([measured[k] - step, measured[k] + step]), OUTLIER, thin)
        else:
            draw_dot(image, measured[k], size, DARK, thin + 2)
            draw_dot(image, measured[k], size, MEASURED, thin)


def write_lines(image: NDArray, lines: Sequence[tuple[str, tuple[int, int, int]]]) -> None:
    """Write lines of text, each with its colour, on a darkened ground at the upper left."""
    scale = max(0.35, min(image.shape[0] / 1920, image.shape[1] / 1080) * 1.25)
    thick, pad = max(1, round(2 * scale)), round(16 * scale)
    sizes = [cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)[0] for text, _ in lines]
    step = max(h for _, h in sizes) + pad
    ground = image[: step * len(lines) + pad, : max(w for w, _ in sizes) + 2 * pad]
    ground[:] = ground // 3
    for i, (text, colour) in enumerate(lines, 1):
        cv2.putText(image, text, (pad, step * i), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thick, cv2.LINE_AA)


def draw_line(
    image: NDArray, uv: NDArray, colour: tuple[int, int, int], thickness: int, dash: float = 0.0
) -> None:  # fmt: skip
    """Draw a line through pixels (N, 2); with `dash` [px] in pieces of that length and gaps as long."""
    uv = uv[np.isfinite(uv).all(-1) & (np.abs(uv) < _MAX_DRAWN_PX).all(-1)]
    if len(uv) >= 2:
        pieces = _dashes(uv, dash) if dash else [uv]
        points = [np.rint(piece * (1 << _SUBPIXEL_BITS)).astype(np.int32) for piece in pieces]
        cv2.polylines(image, points, False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _dashes(uv: NDArray, length: float) -> list[NDArray]:
    """Every other piece, `length` px long, of a line through pixels (N, 2)."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    at = np.append(np.arange(0.0, way[-1], 0.5 * length), way[-1])
    samples = np.stack([np.interp(at, way, column) for column in uv.T], axis=1)
    return [samples[k : k + 3] for k in range(0, len(samples) - 1, 4)]


def draw_dot(image: NDArray, uv: NDArray, radius: float, colour: tuple[int, int, int], thickness: int) -> None:
    """Draw a circle about a pixel (2,), filled with a thickness of -1; none where it is not finite."""
    if np.isfinite(uv).all() and (np.abs(uv) < _MAX_DRAWN_PX).all():
        x, y, r = (round(float(v) * (1 << _SUBPIXEL_BITS)) for v in (uv[0], uv[1], radius))
        cv2.circle(image, (x, y), r, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def depth_colours(depth: NDArray, near: float, far: float) -> NDArray[np.uint8]:
    """Depth (H, W) [m] as colours (H, W, 3) RGB: red at `near` [m], blue at `far`, black for pixels without depth."""
    has_depth = depth > 0.0
    share = np.where(has_depth, np.clip((far - depth) / (far - near), 0.0, 1.0), 0.0)
    out = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    out[~has_depth] = 0
    return np.asarray(out, np.uint8)


def hide_circles(image: NDArray[np.uint8], circles: NDArray) -> NDArray[np.uint8]:
    """A copy of a picture (H, W, 3) uint8 in which nothing can be made out within circles (N, 3) [px] u, v, radius."""
    out = np.array(image, order="C")
    classes = np.ceil(np.log2(np.maximum(circles[:, 2], 1.0)))
    for size in np.unique(classes):  # circles of nearly one radius at once, large ones last
        mask = np.zeros(image.shape[:2], np.uint8)
        for u, v, radius in circles[classes == size]:
            cv2.circle(mask, (round(u), round(v)), max(1, round(radius)), 1, -1)
        left, top, width, height = cv2.boundingRect(mask)
        if width and height:
            part, inside = (a[top : top + height, left : left + width] for a in (out, mask))
            cv2.copyTo(_coarse(part, 2 * 2**size / _BLOCKS), inside, part)
    return out


def hide_all(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A copy of an image with all people unrecognisable."""
    return _coarse(image, max(image.shape[:2]) / _ALL_BLOCKS)


def _coarse(image: NDArray[np.uint8], block: float) -> NDArray[np.uint8]:
    """The picture in blocks of so many pixels, blended."""
    height, width = image.shape[:2]
    few = (max(1, round(width / block)), max(1, round(height / block)))
    small = cv2.resize(image, few, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
