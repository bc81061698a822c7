"""Streams of a take: what `kinefit live` follows as it comes, in place of recordings."""

from __future__ import annotations

from collections.abc import Iterator

from kinefit.errors import TakeError, command
from kinefit.readers.take.entries import SINGLE_TABLES, Take


def streams_of(take: Take) -> list[str]:
    """Every sensor of a take that has a `stream`, as messages name it."""
    return [name for _, name, entry in take.entries if getattr(entry, "stream", None) is not None]


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
    streaming = {camera.name for camera in take.cameras if camera.stream is not None}
    for source in take.keypoints:
        if source.stream is not None and source.camera in streaming:
            place = f"keypoints of camera {source.camera}"
            yield "its camera also has a stream", place, "Remove one: the detector runs on the camera's stream."
    streams = streams_of(take)
    if not streams:
        return
    recorded = [
        name for table, name, entry in take.entries
        if table not in SINGLE_TABLES and getattr(entry, "stream", None) is None
        and (table != "camera" or entry.video is not None)
    ]  # fmt: skip
    recorded += ["[start] clicks"] * (take.clicks is not None)
    seen = {entry.camera for entry in take.keypoints}
    blind = [entry.name for entry in take.cameras if entry.stream is None and entry.name not in seen]
    if recorded:
        yield f"a recording cannot be combined with streams ({streams[0]})", recorded[0], "Remove it."
    elif blind and streaming:
        yield "it has no stream, others have", f"camera {blind[0]}", "Give each camera a stream, or remove it."
