"""A live scene: follow a tracker, or any program that has states of a body."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from time import monotonic
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import BodyError, CalibrationError, choices
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.studio.serving.access import Access
from kinefit.studio.viewers import figure, scene, stage

_TELL_INTERVAL_S, _RATE_INTERVAL_S = 0.2, 2.0  # of the words on the page; of the mean of the frame rate


class View:
    """A body, and cameras if there are any, in a page of this computer's browser.

    Use it around a tracker's loop::

        with View(body, rig, up="z") as view:
            print(view.address)
            for time, uv, confidence in frames:
                result = tracker.update(uv, confidence)
                view.show(result.state, time=time)

    Parameters
    ----------
    body : Body
    rig : Rig, optional
    image_frames : {camera: ImageFrame}, optional
        From the calibration to the pictures that are shown; by default they are the same.
    up : str
        Vertical axis of the world: "x", "y", "z", "-x", "-y" or "-z".
    floor : float [m]
        Height of the floor along it.
    port : int
        The next free one is taken where it is in use; 0 for any.
    host : str
        "127.0.0.1" shows the page on this computer alone, "0.0.0.0" to all that can reach it and know the address: a
        warning says what that means.
    token : str, optional
        Of the address, 16 characters or more; by default a random one.

    Raises
    ------
    ExportError
        viser is missing, or nothing can be served; a token that cannot be used.
    """

    def __init__(
        self,
        body: Body,
        rig: Rig | None = None,
        *,
        image_frames: Mapping[str, ImageFrame] | None = None,
        up: str = "z",
        floor: float = 0.0,
        port: int = 8080,
        host: str = "127.0.0.1",
        token: str | None = None,
    ) -> None:
        self.body = body
        self._up, self._floor, self._rig = up, floor, rig
        self._access = Access(host, token)
        if self._access.warning:
            warnings.warn(self._access.warning, stacklevel=2)
        self.server = stage.open_server(port, self._access, label=f"kinefit: {body.name}")
        self._figure: figure.Figure | None = None
        self._stage: stage.Stage | None = None
        self._frames = dict(image_frames or {})
        self._maps: dict[str, NDArray] = {}
        self._time = self.server.gui.add_markdown("waiting for the first state")
        with self.server.gui.add_folder("Angles", expand_by_default=False):
            self._angles = self.server.gui.add_markdown("")
        self._shown, self._told, self._since = 0, 0.0, monotonic()  # states, and [s] of the last words about them
        boxes = {part: self.server.gui.add_checkbox(part, part in figure.DEFAULT_PARTS) for part in figure.PARTS}
        self._boxes = boxes

    @property
    def address(self) -> str:
        """Where the page is, with its token."""
        return self._access.url(self.server.get_port())

    def show(
        self,
        state: BodyState,
        *,
        time: float | None = None,
        joint_std: NDArray | None = None,
        quality: NDArray | None = None,
        images: Mapping[str, NDArray[np.uint8]] | None = None,
    ) -> None:
        """Show a state of the body.

        Parameters
        ----------
        state : BodyState
        time : float [s], optional
        joint_std : (S, 3) [m], optional
            Standard deviations of the joint centres along the world's axes, as in `Motion.joint_std`.
        quality : (S,) in 0..1, optional
            Of the segments; those with 0 become grey.
        images : {camera: (H, W, 3) uint8 RGB}, optional
            What cameras of the rig saw.

        Raises
        ------
        BodyError
            The state is of another body.
        CalibrationError
            A picture of a camera that is not in the rig.
        """
        if len(state.angles) != len(self.body.tree.coordinates):
            raise BodyError(
                f"a state of {len(state.angles)} angles for a body of {len(self.body.tree.coordinates)}",
                remedy="Give a state of the view's body.",
            )
        Ts = self.body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0]
        with self.server.atomic():
            if self._stage is None or self._figure is None:
                self._stage = stage.Stage(
                    self.server, up=self._up, points=Ts[:, :3, 3], floor=self._floor, rig=self._rig
                )
                self._figure = figure.Figure(self.server.scene, "body", self.body)
            for part, box in self._boxes.items():
                self._figure.show(part, box.value)
            self._figure.pose(Ts, joint_std=joint_std, quality=quality)
            for name, image in (images or {}).items():
                picture = self._flat(name, image)
                self._stage.cameras[name].show(picture)
        self._shown += 1
        if (now := monotonic()) - self._told > _TELL_INTERVAL_S:
            rate, self._told = self._shown / max(now - self._since, 1e-3), now
            self._time.content = f"**{time:.3f} s**, {rate:.0f} Hz" if time is not None else f"{rate:.0f} Hz"
            tree = self.body.tree
            scales = np.where(tree.prismatic, 1000.0, 180 / np.pi)
            names = map(scene.as_markdown, tree.coordinates)
            values = zip(names, scales * state.angles, tree.prismatic, strict=True)
            self._angles.content = "\n\n".join(f"{n} **{v:.1f}**{' mm' if slides else '°'}" for n, v, slides in values)
            if now - self._since > _RATE_INTERVAL_S:
                self._shown, self._since = 0, now

    def _flat(self, name: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._rig is None or name not in self._rig:
            raise CalibrationError(choices("camera", name, self._rig.names if self._rig else ()))
        if name not in self._maps:
            view = stage.flat_view(self._rig[name], stage.FRUSTUM_IMAGE_PX)
            self._maps[name] = stage.undistortion(
                self._rig[name], self._frames.get(name, ImageFrame.identity()), view
            )
        return stage.flatten(image, self._maps[name])

    def close(self) -> None:
        """End the server."""
        with stage.quiet():
            self.server.stop()

    def __enter__(self) -> View:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
