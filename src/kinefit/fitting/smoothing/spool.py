"""Store records of every frame of a long take: small ones in memory, large ones in a temporary file.

Classes of the records that tracking and smoothing store; files with other classes are not read.
"""

from __future__ import annotations

import tempfile
import weakref
from array import array
from collections.abc import Iterable, Sequence
from typing import Any, Generic, TypeVar, overload

from kinefit._records import Codec, RecordFile
from kinefit.bodies import BodyState, PointSet
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import ExportError
from kinefit.fitting.frame.results import FrameResult
from kinefit.geometry.losses import Loss
from kinefit.images.regions import Ratios, RegionColours
from kinefit.sensors.base import Leftover, RowsOf
from kinefit.sensors.displaced import Displaced, DisplacedMatched
from kinefit.sensors.points import body_trackers, image_lines, keypoints, lifted, markers, poses
from kinefit.sensors.regions import region_parts, regions, silhouette
from kinefit.sensors.surfaces import depth_image, point_cloud, surface_points
from kinefit.sensors.visibility.occlusion import Hidden
from kinefit.solving.correspondences.contours.outlines import Rim

CODEC = Codec([
    BodyState, PointSet, SurfaceAnchors, Rim, FrameResult, Ratios, RegionColours, Loss, Leftover, RowsOf,
    depth_image.DepthImageMatched, depth_image.DepthImageMeasurement, Displaced, DisplacedMatched,
    image_lines.ImageLineMatched, image_lines.ImageLineMeasurement, keypoints.KeypointMatched,
    keypoints.KeypointMeasurement, lifted.LiftedMatched, lifted.LiftedMeasurement, markers.MarkerMatched,
    markers.MarkerMeasurement, Hidden, point_cloud.PointCloudMatched, point_cloud.PointCloudMeasurement,
    region_parts.Coloured, region_parts.Kept, regions.RegionMatched, region_parts.Lines, region_parts.Seams,
    regions.RegionMeasurement, silhouette.SilhouetteMatched, silhouette.SilhouetteMeasurement, point_cloud.FreePairs,
    point_cloud.SurfacePairs, surface_points.SurfacePointMatched, surface_points.SurfacePointMeasurement,
    body_trackers.BodyTrackerMatched, body_trackers.BodyTrackerMeasurement, poses.PoseMatched, poses.PoseMeasurement,
])  # fmt: skip
"""Writes and reads records of tracked frames, without what all frames share (bodies, sensors, cameras)."""


T = TypeVar("T")

IN_MEMORY = 16 * 2**20
"""Bytes of each kind that stay in memory: depth and silhouettes of some seconds, keypoints of a minute."""

STRETCH = 2000
"""Frames for which arrays over all channels are made at a time."""


MATRIX_FRAMES = 100
"""Frames whose (n, n) matrices are made at a time: some 2 MB of each."""


def stretches(frames: int, length: int | None = None) -> list[slice]:
    """Slices of a take, each of `length` frames at most; default: `STRETCH`, which keeps arrays of channels small."""
    length = length or STRETCH
    return [slice(start, min(start + length, frames)) for start in range(0, max(frames, 1), length)]


class Store:
    """A file of records, and the objects to which they refer.

    Records contain arrays and the classes of `record_classes`. All other objects (bodies, sensors, cameras,
    measurements of the user's own sensors) stay in memory.

    Parameters
    ----------
    in_memory : bytes up to which no file is made; default `IN_MEMORY`
    records : file that stays; default: a temporary one
    codec : that writes and reads the records
    """

    def __init__(
        self, in_memory: int | None = None, *, records: RecordFile | None = None, codec: Codec = CODEC
    ) -> None:
        if records is None:
            file = tempfile.SpooledTemporaryFile(max(IN_MEMORY if in_memory is None else in_memory, 1))
            weakref.finalize(self, file.close)
            records = RecordFile(file)
        self._records, self._codec, self._shared, self._numbers = records, codec, list[Any](), dict[int, int]()

    def write(self, thing: Any, tag: int = 0, number: int = 0) -> int:
        """Write an object; returns the byte at which it starts. Tag and number: see `RecordFile.append`.

        Raises
        ------
        ExportError
            The disk is full.
        """
        try:
            return self._records.append(self._codec.encode(thing, self._refer), tag, number)
        except OSError as error:
            raise self._full(error) from error

    def read(self, at: int) -> Any:
        """A copy of the object written at a byte.

        Raises
        ------
        FileError
            The record is damaged.
        """
        return self._codec.decode(self._records.read(at), self._resolve, name=self._records.name)

    def _full(self, error: OSError) -> ExportError:
        remedy = "Set TMPDIR to a folder with more room: up to 1 MB for each frame with depth or silhouettes."
        return ExportError(f"frames cannot be kept: {error.strerror}", file=tempfile.gettempdir(), remedy=remedy)

    def _refer(self, thing: Any) -> int | str:
        number = self._numbers.get(id(thing))
        if number is None:
            number = self._numbers[id(thing)] = len(self._shared)
            self._shared.append(thing)
        return number

    def _resolve(self, reference: int | str) -> Any:
        return self._shared[reference]  # type: ignore[index]


class Spool(Sequence[T], Generic[T]):
    """A sequence of records of many frames, in memory or in a temporary file; each read returns a copy.

    The file is in the system's temporary folder (`TMPDIR`), without a name if the system allows it. It is deleted with
    the spool or the process.

    Parameters
    ----------
    things : first records
    in_memory : see `Store`
    store : shared by several spools; default: a new one
    tag : of this spool's records in the store
    places : bytes at which records start that the store has already
    """

    def __init__(
        self, things: Iterable[T] = (), *, in_memory: int | None = None, store: Store | None = None, tag: int = 0,
        places: Iterable[int] = (),
    ) -> None:  # fmt: skip
        self._store, self._tag, self._places = store or Store(in_memory), tag, array("q", places)
        self._last: tuple[int, T] | None = None
        for thing in things:
            self.append(thing)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, which: int) -> T: ...

    @overload
    def __getitem__(self, which: slice) -> Spool[T]: ...

    def __getitem__(self, which: int | slice) -> T | Spool[T]:
        if isinstance(which, slice):
            return self.chosen(range(len(self))[which])
        place = self._places[which]
        if self._last is None or self._last[0] != place:
            self._last = place, self._store.read(place)
        return self._last[1]

    def __setitem__(self, which: int, thing: T) -> None:
        self._places[which] = self._store.write(thing, self._tag)

    def append(self, thing: T, number: int = 0) -> None:
        """Append a record; `number` is stored with it, for a scan of the file.

        Raises
        ------
        ExportError
            The temporary folder is full.
        """
        self._places.append(self._store.write(thing, self._tag, number))

    def chosen(self, which: Iterable[int]) -> Spool[T]:
        """A spool of some of the records, in this order, in the same store."""
        return Spool(store=self._store, tag=self._tag, places=[self._places[i] for i in which])
