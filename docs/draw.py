"""Images of the pages: `python docs/draw.py NAME ...`.

demo    images/demo.webp: the four overlay videos of `kinefit demo` beside the figure in 3D
people  images/people.jpg: `kinefit track --hide-faces` of two people, from $KINEFIT_DATA/video_two_people_4cam
studio  images/studio.svg: where four cameras stand, seen from above
"""

from __future__ import annotations

import os
import sys
import tempfile
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray
from PIL import Image

from kinefit import Motion, read_motion
from kinefit.cli import main
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.readers.video import Video
from kinefit.rendering import Canvas
from kinefit.rendering.colours import side_colour
from kinefit.rendering.person_skin import person_skin

_IMAGES = Path(__file__).parent / "images"
_HEIGHT, _STEP, _SPEED = 360, 4, 80  # [px], every which frame, [ms] each is shown
_FIGURE, _PAPER = 300, (247, 249, 251)
_FINER = 3  # times: the figure is rendered so much larger, then reduced


def demo() -> None:
    """The moving image of README."""
    with tempfile.TemporaryDirectory() as work:
        done = CliRunner().invoke(main, ["demo", "--out", work])
        if done.exit_code:
            raise SystemExit(done.output)
        motion = read_motion(Path(work) / "motion.npz")
        videos = [Video(path) for path in sorted((Path(work) / "overlays").glob("*.mp4"))]
        count = min(len(motion), *map(len, videos))
        frames = [
            np.hstack([*(_reduced(video.read(i)) for video in videos), _figure(motion, i, i / count)])
            for i in range(0, count, _STEP)
        ]
    first, *others = map(Image.fromarray, [*frames, *frames[-2:0:-1]])
    first.save(_IMAGES / "demo.webp", save_all=True, append_images=others, duration=_SPEED, loop=0, quality=60)


def people() -> None:
    """The image of several people: one of two who were tracked, in all views."""
    recording = Path(os.environ["KINEFIT_DATA"]) / "video_two_people_4cam"
    with tempfile.TemporaryDirectory() as work:
        for path in recording.iterdir():
            (Path(work) / path.name).symlink_to(path)
        done = CliRunner().invoke(main, ["track", work, "--hide-faces", "--no-report", "-q"])
        if done.exit_code:
            raise SystemExit(done.output)
        montage = cv2.imread(str(Path(work) / "take-kinefit" / "person-2" / "montage.png"))
    height, width = montage.shape[:2]
    small = cv2.resize(montage, (1000, round(1000 * height / width)), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(_IMAGES / "people.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 85])


def _reduced(image: NDArray) -> NDArray:
    height, width = image.shape[:2]
    return cv2.resize(image, (round(width * _HEIGHT / height), _HEIGHT), interpolation=cv2.INTER_AREA)


def _figure(motion: Motion, i: int, share: float) -> NDArray:
    """(H, W, 3) uint8 the body in frame i on a floor, from a camera that sways about it."""
    x = motion.segment_poses()[..., :3, 3]
    middle = 0.5 * (x.reshape(-1, 3).min(axis=0) + x.reshape(-1, 3).max(axis=0))
    angle = np.radians(30.0 + 40.0 * np.sin(np.pi * share))
    size = _FINER * _FIGURE, _FINER * _HEIGHT
    place = middle + 4.6 * np.array([np.cos(angle), np.sin(angle), 0.25])
    z = (middle - place) / np.linalg.norm(middle - place)
    across = np.cross(z, [0.0, 0.0, 1.0])
    R = np.stack([across / np.linalg.norm(across), np.cross(z, across) / np.linalg.norm(across), z])
    K = np.array([[1.9 * size[1], 0.0, size[0] / 2], [0.0, 1.9 * size[1], size[1] / 2], [0.0, 0.0, 1.0]])
    camera = Camera("figure", size, K, T_camera_world=se3.transform(R, -R @ place))
    image = np.full((size[1], size[0], 3), _PAPER, np.uint8)
    floor = motion.positions()[..., 2].min()
    for k in np.arange(-5, 6) * 0.25:
        for line in ([[k, -1.25], [k, 1.25]], [[-1.25, k], [1.25, k]]):
            ends = camera.project(np.column_stack([np.array(line) + middle[:2], [floor, floor]]))
            a, b = (tuple(int(v) for v in end) for end in ends)
            cv2.line(image, a, b, (214, 221, 228), _FINER, cv2.LINE_AA)
    shown, shade = _shaded(motion, i, camera)
    image[shown] = shade[shown]
    return cv2.resize(image, (_FIGURE, _HEIGHT), interpolation=cv2.INTER_AREA)


def _shaded(motion: Motion, i: int, camera: Camera) -> tuple[NDArray, NDArray]:
    """(H, W) bool where the body is, and (H, W, 3) uint8 its colour in a light from above the camera."""
    mesh = person_skin(motion.body)
    assert mesh is not None
    frames, _ = motion.body.tree.forward(motion.Ts_world_root[i], motion.angles[i])
    vertices = mesh.posed(frames)
    corners = vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(smooth, mesh.faces[:, k], normals)
    faces = smooth[mesh.faces].mean(axis=1)
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-12)
    light = camera.T_world_camera[:3, :3] @ [0.35, -0.7, -0.6]
    bright = 0.55 + 0.45 * np.clip(faces @ (light / np.linalg.norm(light)), -0.2, 1.0)
    raster = Canvas(camera.size).draw_for(camera, vertices, mesh.faces, cull=True)
    sides = np.array([side_colour(name) for name in motion.body.tree.segments])
    colours = np.clip(bright[:, None] * (0.65 * sides[mesh.face_segment] + 70.0), 0, 255).astype(np.uint8)
    return raster.seen.copy(), colours[raster.face]


def studio() -> None:
    """The plan of the first recording: no two cameras face each other."""
    angles = np.radians([20.0, 105.0, 175.0, 265.0])
    facing = [abs(abs(np.degrees(b - a)) - 180.0) for a, b in combinations(angles, 2)]
    assert min(facing) > 15.0, "two cameras face each other"
    middle, far = np.array([320.0, 232.0]), np.array([250.0, 145.0])
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 460" font-family="system-ui, sans-serif"',
        ' font-size="14"><rect width="640" height="460" fill="#f7f9fb"/>',
        '<rect x="220" y="152" width="200" height="160" rx="8" fill="#e3ecf4" stroke="#9db4c8"',
        ' stroke-dasharray="6 4"/><text x="320" y="304" text-anchor="middle" fill="#37474f">volume, 2 m by 2 m</text>',
        '<ellipse cx="320" cy="232" rx="34" ry="16" fill="#93d08e" stroke="#37474f"/>',
        '<circle cx="320" cy="232" r="11" fill="#c9e8c6" stroke="#37474f"/>',
        '<path d="M320 216 l-7 -12 h14 z" fill="#37474f"/>',
    ]
    for k, angle in enumerate(angles, 1):
        at = middle + far * [np.cos(angle), np.sin(angle)]
        ahead = (middle - at) / np.linalg.norm(middle - at)
        aside = 0.42 * np.array([-ahead[1], ahead[0]])
        ends = [at + 330.0 * (ahead + s * aside) for s in (-1, 1)]
        path = " ".join(f"L{x:.0f} {y:.0f}" for x, y in ends)
        parts.append(f'<path d="M{at[0]:.0f} {at[1]:.0f} {path} Z" fill="#468cff" fill-opacity="0.07" stroke="#468cff" '
                     'stroke-opacity="0.4"/>')  # fmt: skip
        turn = np.degrees(np.arctan2(ahead[1], ahead[0]))
        parts.append('<rect x="-16" y="-9" width="26" height="18" rx="3" fill="#1d2733" '
                     f'transform="translate({at[0]:.0f} {at[1]:.0f}) rotate({turn:.0f})"/>')  # fmt: skip
        x, y = at - np.array([40.0, 24.0]) * ahead
        parts.append(f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle" fill="#37474f">cam{k:02d}</text>')
    parts.append('<text x="320" y="26" text-anchor="middle" fill="#1d2733" font-size="16">'
                 'seen from above: 3 to 4 m from the middle, none opposite another</text>')  # fmt: skip
    parts.append('<text x="320" y="446" text-anchor="middle" fill="#5b6875">'
                 "the person fills half of each image's height and never leaves it</text>")  # fmt: skip
    (_IMAGES / "studio.svg").write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        {"demo": demo, "people": people, "studio": studio}[name]()
