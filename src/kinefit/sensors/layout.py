"""The layout of a body's keypoints: which points of which cameras they are, frame after frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.views import HandViews, beside, limb_groups, trunks
from kinefit.sensors.scene import Scene

Stream = tuple[str, str, tuple[str, ...]]
"""Camera, keypoint set and names of the keypoints that one detector gives frame after frame."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which points of which cameras a body's keypoints are, frame after frame; see `Channels`.

    Parameters
    ----------
    channels : Channels, of which the measurements are not used
    body : Body
    streams : the detector's stream of every source; empty unless made from streams
    """

    channels: Channels
    body: Body
    streams: tuple[Stream, ...] = ()

    @cached_property
    def points(self) -> PointSet:
        """A point of the body for every channel (N,)."""
        return self._of(self.channels)

    @cached_property
    def groups(self) -> NDArray:
        """(N,) channels that change sides together."""
        return limb_groups(self.body, self.channels)

    @cached_property
    def informs(self) -> NDArray:
        """(S, N) 0 or 1: channels that constrain a segment; see `informing`."""
        return informing(self.body, self.channels)

    @cached_property
    def hands(self) -> tuple[HandViews, ...]:
        """The hands with fingers, and which channels are on them."""
        return HandViews.of(self.body, self.channels, self.points)

    @cached_property
    def parts(self) -> list[tuple[str, NDArray, tuple[str, ...], NDArray]]:
        """Of each source its label, its channels (K,), and their names and segments (K,)."""
        points, sources = self.points, self.channels.sources
        of = [np.flatnonzero(self.channels.source == q) for q in range(len(sources))]
        return [(s, k, tuple(points.names[i] for i in k), points.segments[k]) for s, k in zip(sources, of)]

    @cached_property
    def trunk(self) -> NDArray:
        """(N,) segment in whose frame a channel's view bias is given."""
        return trunks(self.body.tree)[self.points.segments]

    def beside(self, scene: Scene) -> NDArray | None:
        """(N, 2) [px] bias of each keypoint in the image at a scene's state; None without a `view_bias`."""
        bias = self.channels.view_bias
        if bias is None:
            return None
        x = scene.positions(self.points_of(scene.body))
        return beside(bias, self.trunk, x, scene.frames, scene.rig, self.channels.camera)

    def points_of(self, body: Body) -> PointSet:
        """`points` of another body with the same segments; cached for the latest body."""
        if body is self.body:
            return self.points
        if self._latest.get("body") is not body:
            self._latest.update(body=body, points=self._of(self.channels.with_points(body)))
        return self._latest["points"]

    @cached_property
    def _latest(self) -> dict[str, Any]:
        return {}

    @cached_property
    def places(self) -> tuple[tuple[str, str], ...]:
        """(N,) keypoint set and name of every channel's point."""
        c = self.channels
        known = [(name, point) for name, span in c.sets.items() for point in c.points.names[span]]
        return tuple(known[k] for k in c.column)

    @property
    def of_streams(self) -> list[tuple[str, str, str]]:
        """(N,) camera, keypoint set and point of every channel."""
        return [(*self.streams[q][:2], name) for q, name in zip(self.channels.source, self.points.names)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(N,) source and point of every channel."""
        return tuple(f"{self.channels.sources[q]} {name}" for q, name in zip(self.channels.source, self.points.names))

    @staticmethod
    def _of(channels: Channels) -> PointSet:
        if not len(channels.column):
            return channels.points
        names = tuple(channels.points.names[c] for c in channels.column)
        owner, place = channels.points.segments, channels.points.points
        return PointSet(names, owner[channels.column], place[channels.column])


def projected(scene: Scene, layout: Layout) -> NDArray:
    """(N, 2) [px] projections of every channel's point at a scene's state; NaN behind the camera."""
    return scene.once(
        layout, lambda: scene.rig.project(scene.positions(layout.points_of(scene.body)), layout.channels.camera)
    )


def informing(body: Body, channels: Channels) -> NDArray:
    """(S, N) 0 or 1: channels that constrain a segment: those on it and those at its children's joints.

    A segment without any has those of its children.
    """
    tree = body.tree
    owner, place = channels.points.segments[channels.column], channels.points.points[channels.column]
    near = np.linalg.norm(place, axis=1) < 0.05
    out = np.zeros((len(tree.segments), len(owner)))
    for s in range(len(tree.segments)):
        out[s] = (owner == s) | (near & (tree.parents[owner] == s))
    for s in range(len(tree.segments) - 1, 0, -1):
        if not out[s].any():
            children = [c for c in range(len(tree.segments)) if tree.parents[c] == s]
            out[s] = np.max([out[c] for c in children], axis=0) if children else 0.0
    return out
