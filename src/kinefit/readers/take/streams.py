"""Streams of a take: what `kinefit live` follows as it comes, in place of recordings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from kinefit.errors import TakeError, command

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take


def streams_of(take: Take) -> list[str]:
    """Every sensor of a take that has a `stream`, as messages name it."""
    out = [f"camera {entry.name}" for entry in take.cameras if entry.stream is not None]
    out += [f"keypoints of camera {entry.camera}" for entry in take.keypoints if entry.stream is not None]
    return out + [f"depth {entry.name}" for entry in take.depth if entry.stream is not None]


def refuse_streams(take: Take) -> None:
    """Refuse a take of streams where a recording is needed.

    Raises
    ------
    TakeError
        With the command that follows them.
    """
    streams = streams_of(take)
    if streams:
        remedy = f"Track it live ({command('live', take.path)}), or name its recording in place of the stream."
        raise TakeError("a stream is no recording", file=take.path, place=streams[0], remedy=remedy)


def odd_streams(take: Take) -> Iterator[tuple[str, str, str]]:
    """Streams that stand beside what excludes them: problem, place, remedy."""
    for camera in take.cameras:
        if camera.stream is not None and camera.video is not None:
            yield "a stream and a video", f"camera {camera.name}", "Remove one of the two."
    for source in take.keypoints:
        place = f"keypoints of camera {source.camera}"
        if source.stream is not None and source.file is not None:
            yield "a stream and a file", place, "Remove one of the two."
        if source.stream is not None and any(c.name == source.camera and c.stream is not None for c in take.cameras):
            yield "its camera also has a stream", place, "Remove one: the detector runs on the camera's stream."
    for entry in take.depth:
        place = f"depth {entry.name}"
        if (entry.stream is None) == (entry.file is None):
            problem = "neither a file nor a stream" if entry.file is None else "a stream and a file"
            yield problem, place, 'Write file = "...", or, for `kinefit live`, stream = "FOLDER".'
        if entry.stream is not None:
            for key in ("time_unit", "segment"):
                if getattr(entry, key) is not None:
                    yield f"'{key}' has no use with a stream", place, "Remove it."
            if entry.intrinsics is not None and entry.size is None:
                yield "a stream with intrinsics, and no size", place, "Write size = [width, height] of its images."
    streams = streams_of(take)
    if not streams:
        return
    recorded = [f"camera {entry.name}" for entry in take.cameras if entry.video is not None]
    recorded += [f"keypoints of camera {k.camera}" for k in (*take.keypoints, *take.skin) if k.stream is None]
    recorded += [f"depth {entry.name}" for entry in take.depth if entry.file is not None]
    tables = {"markers": take.markers, "stereo": take.stereo, "silhouette": take.silhouettes, "region": take.regions,
              "lines": take.lines, "surface_points": take.surface_points,
              "tracker": take.trackers}  # fmt: skip
    recorded += [f"[[{name}]]" for name, entries in tables.items() if entries]
    recorded += ["[start] clicks"] * (take.clicks is not None)
    seen = {entry.camera for entry in take.keypoints}
    blind = [entry.name for entry in take.cameras if entry.stream is None and entry.name not in seen]
    if recorded:
        yield f"a recording cannot be combined with streams ({streams[0]})", recorded[0], "Remove it."
    elif blind and any(entry.stream is not None for entry in take.cameras):
        yield "it has no stream, others have", f"camera {blind[0]}", "Give each camera a stream, or remove it."
