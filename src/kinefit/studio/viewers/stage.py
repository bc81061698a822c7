"""Server of a 3D scene: floor, cameras with their images, and the image behind the person."""

from __future__ import annotations

import contextlib
import io
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import UP_AXES
from kinefit.errors import ExportError
from kinefit.exporters.report.page import scaled
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.readers.videos.video import Video
from kinefit.studio.serving.access import APP_PAGES, Access

if TYPE_CHECKING:
    import viser

_MAX_HALF_WIDTH = np.tan(np.radians(65.0))  # a flat picture of more would be all border
_MAX_CACHE_BYTES = 96_000_000  # bytes of pictures that are kept


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A camera's view without distortion: a centred pinhole camera that covers the whole image.

    Parameters
    ----------
    size : (width, height) [px] of the flat picture.
    tangents : (x, y)
        Of half its angles of view.
    """

    size: tuple[int, int]
    tangents: tuple[float, float]

    @property
    def fov(self) -> float:
        """[rad] vertical angle of view."""
        return 2.0 * float(np.arctan(self.tangents[1]))

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.tangents[0] / self.tangents[1]

    def rays(self) -> NDArray:
        """(H, W, 3) points at depth 1 in the camera's frame that the middles of the pixels show."""
        (w, h), (tx, ty) = self.size, self.tangents
        x, y = (2 * np.arange(w) + 1 - w) / w * tx, (2 * np.arange(h) + 1 - h) / h * ty
        return np.stack([*np.meshgrid(x, y), np.ones((h, w))], axis=-1)

    def pixels(self, x_camera: NDArray) -> NDArray:
        """(..., 2) [px] where points (..., 3) of the camera's frame appear in the flat picture."""
        half = 0.5 * np.array(self.size)
        return (x_camera[..., :2] / x_camera[..., 2:] / self.tangents + 1.0) * half - 0.5


def flat_view(camera: Camera, longest: int) -> PinholeView:
    """The view of a camera whose longer side has `longest` pixels."""
    w, h = camera.size
    u, v = np.linspace(-0.5, w - 0.5, 33), np.linspace(-0.5, h - 0.5, 33)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(u, y), -1) for y in v[[0, -1]]]
        + [np.stack(np.broadcast_arrays(x, v), -1) for x in u[[0, -1]]]
    )
    rays = camera.with_pose(np.eye(4)).ray(border)
    ahead = np.isfinite(rays).all(-1) & (rays[:, 2] > 0)
    slopes = np.abs(rays[ahead, :2] / rays[ahead, 2:])
    plain = 0.5 * np.array([w, h]) / camera.matrix[[0, 1], [0, 1]]  # where no ray reaches the border
    tx, ty = (float(t) for t in np.minimum(slopes.max(axis=0) if len(slopes) else plain, _MAX_HALF_WIDTH))
    scale = longest / max(tx, ty)
    return PinholeView((max(1, round(scale * tx)), max(1, round(scale * ty))), (tx, ty))


def undistortion(camera: Camera, image: ImageFrame, view: PinholeView) -> NDArray:
    """(H, W, 2) [px] of the delivered picture for every pixel of a flat view; NaN where the lens shows nothing."""
    return image.from_calibration(camera.with_pose(np.eye(4)).project(view.rays()))


def flatten(picture: NDArray[np.uint8], pixels: NDArray) -> NDArray[np.uint8]:
    """A delivered picture (H, W, 3) seen through `undistortion`'s map (h, w, 2): (h, w, 3), dark where nothing is."""
    small = scaled(picture, max(pixels.shape[:2]))  # by areas first: the map alone would skip pixels
    if small is not picture:
        pixels = (pixels + 0.5) * (np.array(small.shape[1::-1]) / picture.shape[1::-1]) - 0.5
    maps = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    out = cv2.remap(small, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(40, 40, 40))
    return np.asarray(out, np.uint8)


class CameraImages:
    """Undistorted images of cameras over time, decoded on demand; the last ones are cached.

    Parameters
    ----------
    cameras : {name: Camera}
    videos : {name: path or Video}
        Of some or all of the cameras.
    images : {name: ImageFrame}, optional
        From the calibration to the video; by default they are the same.
    time_offsets : {name: float [s]}, optional
        Added to frame / rate to get the time of the take.
    rate : float [Hz], optional
        Of videos that are folders of images.

    Raises
    ------
    FileError
        A video that cannot be read.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        videos: Mapping[str, Path | Video],
        images: Mapping[str, ImageFrame] | None = None,
        time_offsets: Mapping[str, float] | None = None,
        *,
        rate: float | None = None,
    ) -> None:
        self._cameras, self._images, self._offsets = cameras, images or {}, time_offsets or {}
        self._videos: dict[str, Video] = {}
        self._maps: dict[tuple[str, int], NDArray] = {}
        self._kept: OrderedDict[tuple[str, int, int], NDArray[np.uint8]] = OrderedDict()
        try:
            for name, path in videos.items():
                self._videos[name] = path if isinstance(path, Video) else Video(path, rate=rate)
        except BaseException:
            self.close()
            raise

    def __contains__(self, name: object) -> bool:
        return name in self._videos

    def close(self) -> None:
        """Close all videos."""
        for video in self._videos.values():
            video.close()

    def frame(self, name: str, time: float) -> int | None:
        """Frame of a camera's video nearest to a time [s] of the take; None outside of the video."""
        return self._videos[name].frame_at(time - self._offsets.get(name, 0.0))

    def read(self, name: str, time: float, longest: int) -> NDArray[np.uint8] | None:
        """(h, w, 3) uint8 RGB flat picture of a camera at a time [s]; None without video, or outside of it."""
        i = self.frame(name, time) if name in self._videos else None
        if i is None:
            return None
        key = (name, i, longest)
        if key not in self._kept:
            if (name, longest) not in self._maps:
                camera, image = self._cameras[name], self._images.get(name, ImageFrame.identity())
                self._maps[name, longest] = undistortion(camera, image, flat_view(camera, longest))
            self._kept[key] = flatten(self._videos[name].read(i), self._maps[name, longest])
            while len(self._kept) > 1 and sum(p.nbytes for p in self._kept.values()) > _MAX_CACHE_BYTES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


FRUSTUM_IMAGE_PX = 320  # longer side of a camera's image on its frustum
BACKGROUND_IMAGE_PX = 1080  # the same, behind the scene when looking through the camera
_PLANES = {"x": "yz", "y": "xz", "z": "xy"}
_SHADE = (70, 75, 85)
POLICY = (
    "connect-src 'self' data: blob:; img-src 'self' data: blob:; font-src data:; media-src 'none'; frame-src 'none'; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; "
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:"
)
"""Content security policy of viser's page: its scripts are its own, but what they see they can send nowhere else."""

_FOV, _MAX_FILL = 0.7, 0.9  # [rad] of the first look, and share of the window's height that the person fills then
_MAX_WAY = 2.0  # distance that shows a whole way over that which shows the person, beyond which the person is followed
_MIN_DISTANCE = 1.0  # [m] of the first look: parts of a body are not seen from within


def open_server(port: int, access: Access | None = None, *, label: str = "kinefit") -> viser.ViserServer:
    """A server on a port, or on the next one that is free; `get_port()` returns its number.

    Parameters
    ----------
    access : who may connect, at `access.url(server.get_port())`; default: this computer with a random token

    Raises
    ------
    ExportError
        viser is not installed, no port is free, the host's name is not one of this computer, or this version of viser
        cannot be kept from foreign pages.
    """
    try:
        import viser
    except ImportError as error:
        remedy = "Install it: pip install viser."
        raise ExportError("the 3D viewer needs the package viser", remedy=remedy) from error
    from kinefit.studio.serving.server import listen

    access = access or Access()
    with listen(access.host, port, search=True) as free:
        port = free.getsockname()[1]
    with quiet(), _guarded(access) as used:
        server = viser.ViserServer(host=access.host, port=port, label=label, verbose=False)
        if not used:
            server.stop()
            raise ExportError(f"viser {viser.__version__} is not supported", remedy="Install viser 1.1.")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    return server


_GUARDING = threading.Lock()


@contextlib.contextmanager
def _guarded(access: Access) -> Iterator[list[int]]:
    """Put `access` before the pages of a viser server that is made meanwhile; the list has its port then.

    viser has no place for it, and asks `websockets.asyncio.server` by name for what it serves with.
    """
    from websockets.asyncio import server

    from kinefit.studio.serving.server import connection_log, guard

    plain, used = server.serve, list[int]()

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def respond(connection: Any, request: Any) -> Any:
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = f"{POLICY}; frame-ancestors {APP_PAGES}"
            return response

        used.append(port)
        options |= {"process_request": guard(access, respond), "logger": connection_log()}
        return plain(handler, host, port, **options)

    with _GUARDING:
        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield used
        finally:
            server.serve = plain  # type: ignore[misc]


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep viser's own notes off the terminal."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


class CameraNode:
    """A camera in the scene: its frustum with its picture, and a backdrop that is seen when looking through it."""

    def __init__(self, scene: Any, camera: Camera, *, size: float, far: float) -> None:
        self.camera, self.far = camera, far
        self.view: PinholeView = flat_view(camera, FRUSTUM_IMAGE_PX)
        T = camera.T_world_camera
        self.wxyz, self.position = se3.quaternion(T[:3, :3]), T[:3, 3]
        tx, ty = self.view.tangents
        scale = size / max(tx, ty) * float(np.cbrt(tx * ty / 3.0))  # viser's is of the frustum's volume
        self.frustum = scene.add_camera_frustum(
            f"/world/cameras/{camera.name}", fov=self.view.fov, aspect=self.view.aspect, scale=scale, color=_SHADE,
            wxyz=self.wxyz, position=self.position, thickness=0.004, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        label = scene.add_label(f"/world/cameras/{camera.name}/name", camera.name)
        label.position = (0.0, -0.6 * size, 0.0)
        self._backdrop: Any = None
        self._scene = scene

    def show(self, picture: NDArray[np.uint8] | None) -> None:
        """Put a picture on the frustum."""
        if picture is not self.frustum.image:
            self.frustum.image = picture

    def look(self, picture: NDArray[np.uint8] | None) -> None:
        """Put a picture behind the scene, as seen from this camera; None takes it away."""
        if picture is None:
            if self._backdrop is not None:
                self._backdrop.remove()
                self._backdrop = None
        elif self._backdrop is None:
            (tx, ty), middle = self.view.tangents, self.position + self.far * self.camera.T_camera_world[2, :3]
            self._backdrop = self._scene.add_image(
                f"/world/backdrop/{self.camera.name}", picture, 2 * self.far * tx, 2 * self.far * ty, jpeg_quality=80,
                wxyz=self.wxyz, position=middle, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        elif picture is not self._backdrop.image:
            self._backdrop.image = picture


class Stage:
    """Scene with the up-axis right, a floor and cameras.

    Parameters
    ----------
    server : viser.ViserServer
    up : str
        Vertical axis of the world, as `Motion.up`.
    points : (N, 3) [m]
        Where things are over time: the floor lies under them.
    floor : float [m]
        Height of the floor along the vertical axis.
    rig : Rig, optional
    person : (M, 3) [m], optional
        Where the person is at first. The first look shows all `points`, or the person alone where these reach so far
        that it would be small; `goes_far` says so.
    facing : (3,), optional
        Direction in which the person looks: the first look comes rather from the front.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        up: str,
        points: NDArray,
        floor: float,
        rig: Rig | None = None,
        person: NDArray | None = None,
        facing: NDArray | None = None,
    ) -> None:
        self.server, self.scene = server, server.scene
        self._vertical = vertical = np.array(UP_AXES[up])
        points = np.asarray(points, float).reshape(-1, 3)
        points = points[np.isfinite(points).all(-1)]
        points = points if len(points) else np.zeros((1, 3))
        middle = 0.5 * (points.min(0) + points.max(0))
        reach = max(1.0, float(np.linalg.norm(np.ptp(points, axis=0))))
        centres = np.array([camera.centre_world for camera in rig or ()]).reshape(-1, 3)
        self.width = 2 * float(np.ceil(np.abs(np.concatenate([points, centres]) - middle).max() + 0.5))
        far = max([reach, *np.linalg.norm(centres - middle, axis=1)])
        with server.atomic():
            self.scene.set_up_direction(tuple(vertical))  # type: ignore[arg-type]
            self.scene.world_axes.visible = False
            self._world = self.scene.add_frame("/world", show_axes=False)
            at = np.round(middle - (middle @ vertical) * vertical) + floor * vertical
            plane: Any = _PLANES[up[-1]]
            self.grid = self.scene.add_grid(
                "/world/floor", self.width, self.width, plane=plane, position=at, cell_color=(215, 215, 215)
            )
            size = min(0.3, 0.1 * far)  # [m] half the longer side of a camera's picture
            self.cameras = {c.name: CameraNode(self.scene, c, size=size, far=2.0 * far) for c in rig or ()}
        eye = first_look(centres - middle, vertical, facing)
        target, distance = framing(points, eye)
        self.goes_far = False
        if len(points) == 1:  # cameras alone are seen from outside
            distance = 2.0 * far
        elif person is not None and len(person):
            near, close = framing(person, eye)
            self.goes_far = distance > _MAX_WAY * close
            target, distance = (near, close) if self.goes_far else (target, distance)
        look = server.initial_camera
        look.position = target + distance * eye
        look.look_at = target
        look.up = vertical
        look.fov = _FOV

    def shift(self, way: NDArray) -> None:
        """Draw everything shifted by (3,) [m] along the floor; the part along the vertical is left out."""
        self._world.position = way - (way @ self._vertical) * self._vertical


def framing(points: NDArray, eye: NDArray) -> tuple[NDArray, float]:
    """Middle (3,) [m] of points (N, 3), and the distance [m] in the direction `eye` from which a window shows them."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    along = (points - middle) @ eye
    across = np.linalg.norm(points - middle - along[:, None] * eye, axis=1)
    return middle, max(float(np.max(along + across / (_MAX_FILL * np.tan(0.5 * _FOV)))), _MIN_DISTANCE)


def first_look(cameras: NDArray, vertical: NDArray, facing: NDArray | None = None) -> NDArray:
    """(3,) direction from the middle towards the eye: from above, in the widest gap between the cameras (C, 3).

    With `facing` (3,), the direction in which a person looks, a gap before the person is preferred to one behind.
    """
    side = np.roll(vertical, 1)
    level = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    ways = np.cos(level)[:, None] * side + np.sin(level)[:, None] * np.cross(vertical, side)
    flat = cameras - (cameras @ vertical)[:, None] * vertical
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    nearest = (ways @ flat.T).max(axis=1) if len(flat) else ways @ -(side + 0.6 * np.cross(vertical, side))
    front = 0.0 if facing is None else ways @ facing
    eye = ways[np.argmin(nearest - front)] + 0.35 * vertical
    return eye / np.linalg.norm(eye)


def look_through(client: Any, node: CameraNode) -> None:
    """Set a browser's view to a camera's: its pose, and a field of view that holds its whole picture."""
    tx, ty = node.view.tangents
    aspect = max(float(client.camera.aspect), 1e-3)
    T = node.camera.T_world_camera
    with client.atomic():
        client.camera.up_direction = -T[:3, 1]
        client.camera.position = T[:3, 3]
        client.camera.look_at = T[:3, 3] + T[:3, 2]
        client.camera.fov = fitting_fov((tx, ty), aspect)


def fitting_fov(tangents: tuple[float, float], aspect: float) -> float:
    """[rad] vertical angle of a window of an aspect (width / height) that holds a view of half-angle tangents."""
    return 2.0 * float(np.arctan(max(tangents[1], tangents[0] / aspect)))
