"""From a take file to a live session: its streams, or what it recorded, replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinefit._threads import cores
from kinefit.bodies import Body, load_body
from kinefit.errors import TakeError
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.identification.take.named import with_names
from kinefit.live.cameras import CameraStream, Clock, FolderStream, VideoReplay
from kinefit.live.detecting import LiveDetector
from kinefit.live.people import LivePerson
from kinefit.live.replay import Replay
from kinefit.live.seen import SeenRecord
from kinefit.live.session import LiveSession, Receiver, Source
from kinefit.live.sizing import LiveSize
from kinefit.preparing.detecting import Tell, hush, networks
from kinefit.preparing.take import warn
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import image_frame, load_observations, read_rig
from kinefit.readers.take.one_camera import assumed_camera, is_alone
from kinefit.tracking.recording import Recording
from kinefit.tracking.run import tracker_of
from kinefit.tracking.take import settings_of, trial_of
from kinefit.tracking.take_recording import recording_of

_SIGMA = 8.0  # [px] of the built-in detector's keypoints, as in takes
_RATE = 30.0  # [Hz] of streams that nothing states a rate of


@dataclass(frozen=True, eq=False)
class _Opened:
    """What the session is made of."""

    recording: Recording
    body: Body
    sources: tuple[Source, ...]
    detector: LiveDetector | None = None


def live_session(
    take: Take, receivers: Sequence[Receiver] = (), *, speed: float = 1.0, threads: int | None = None,
    folder: Path | None = None, tell: Tell = warn,
) -> LiveSession:
    """A session of a take: live where its cameras have a `stream`, else what it recorded at its own speed.

    Videos without keypoints are looked through by the built-in detector as they come.

    Parameters
    ----------
    receivers : of the poses
    speed : of a replay; 0 as fast as it can be followed, and no frame is dropped
    threads : of the detector; default: all cores
    folder : where what the detector saw of the person is left as a take; None for nowhere
    tell : called with what is worth saying

    Raises
    ------
    TakeError
        Some cameras have streams and others none; sensors that only a recording has beside streams; a person who is
        known only when all is over.
    KinefitError
        What opening and reading raise.
    """
    body = load_body(take.body) if take.start is None else read_motion(take.start).body
    streams = [entry for entry in take.cameras if entry.stream is not None]
    threads = threads or cores()
    if streams:
        opened = _streams(take, body, threads, tell)
    elif take.cameras and not (take.keypoints or take.skin or take.lines or take.depth or take.stereo or take.markers
                               or take.silhouettes or take.regions or take.surface_points):  # fmt: skip
        opened = _videos(take, body, speed, threads, tell)
    else:
        opened = _recorded(take, body, speed)
    recording, settings = opened.recording, settings_of(take)
    trial = trial_of(take)
    body = opened.body if trial is None else trial.body
    tracker = tracker_of(recording, body, settings)
    if recording.start is not None:
        tracker.start_at(recording.start[1])
    sized = trial is not None or take.start is not None or take.size is False
    sigma = {k: v for k, v in tracker.accuracy.items() if k in recording.rig.names}
    size = None if sized or not (streams or opened.detector or take.keypoints) else LiveSize(
        body, recording.rig, sigma=sigma, settings=settings, height=take.height, up=take.up
    )  # fmt: skip
    seen = None
    if folder is not None and opened.detector is not None:
        seen = SeenRecord(folder, take, recording.rig, rate=recording.rate, alone=is_alone(take))
    return LiveSession(
        tracker, opened.sources, receivers, detector=opened.detector, person=LivePerson(recording.rig, take.person),
        size=size, seen=seen, name=take.name,
    )  # fmt: skip


def _recorded(take: Take, body: Body, speed: float) -> _Opened:
    """Everything that a take recorded, step by step."""
    seen = with_names(take, load_observations(take))
    recording, body = recording_of(take, seen, body)
    others = recording if recording.alone is None else replace(recording, steps=lambda i: ())
    return _Opened(recording, body, (Replay(others, seen.keypoints, speed=speed),))


def _videos(take: Take, body: Body, speed: float, threads: int, tell: Tell) -> _Opened:
    """Videos, looked through as they are shown."""
    entries = [entry for entry in take.cameras if entry.video is not None]
    if not entries:
        remedy = "Give its cameras a stream or a video."
        raise TakeError("cameras, but nothing that they saw", file=take.path, remedy=remedy)
    clock, sources = Clock(), []
    for entry in entries:
        assert entry.video is not None
        sources.append(VideoReplay(
            entry.name, entry.video, clock, rate=take.rate, offset=entry.time_offset, speed=speed, frames=take.frames
        ))  # fmt: skip
    sizes = {source.name: source.size for source in sources}
    rate = min(source.rate for source in sources)
    return _with_detector(take, body, sources, sizes, rate, threads, tell)


def _streams(take: Take, body: Body, threads: int, tell: Tell) -> _Opened:
    """Cameras that see now."""
    without = [entry.name for entry in take.cameras if entry.stream is None]
    if without:
        problem = f"camera {without[0]} has no stream, others have"
        raise TakeError(problem, file=take.path, remedy="Give each camera a stream, or leave it out.")
    beside = {"keypoints": take.keypoints, "markers": take.markers, "depth": take.depth, "stereo": take.stereo,
              "silhouette": take.silhouettes, "region": take.regions, "lines": take.lines,
              "surface_points": take.surface_points}  # fmt: skip
    recorded = [name for name, entries in beside.items() if entries]
    if recorded:
        problem = "what was recorded stands beside streams"
        raise TakeError(problem, file=take.path, place=f"[[{recorded[0]}]]", remedy="Leave it out.")
    sizes = {entry.name: entry.size for entry in take.cameras if entry.size is not None}
    rig = read_rig(take)
    clock, sources = Clock(), list[Source]()
    for entry in take.cameras:
        assert entry.stream is not None
        size = sizes.get(entry.name) or (rig[entry.name].size if rig is not None else None)
        if size is None:
            remedy = "Write size = [width, height], or a calibration."
            raise TakeError("nothing tells the size of its image", file=take.path, place=f"camera {entry.name}",
                            remedy=remedy)  # fmt: skip
        sizes[entry.name] = size
        folder = take.path.parent / entry.stream
        kind = FolderStream if folder.is_dir() else CameraStream
        sources.append(kind(entry.name, folder if folder.is_dir() else entry.stream, size, clock))  # type: ignore[arg-type]
    return _with_detector(take, body, sources, sizes, take.rate or _RATE, threads, tell)


def _with_detector(
    take: Take, body: Body, sources: Sequence[Source], sizes: dict[str, tuple[int, int]], rate: float, threads: int,
    tell: Tell,
) -> _Opened:  # fmt: skip
    """Sources of images, with the detector that looks through them."""
    rig = read_rig(take)
    if is_alone(take):
        rig = Rig((assumed_camera(take.cameras[0], sizes.get(take.cameras[0].name), take),))
    if rig is None:
        raise TakeError("cameras without calibration", file=take.path, remedy='Add [calibration] with file = "...".')
    images = dict[str, ImageFrame]()
    for entry in take.cameras:
        if entry.name in sizes:
            images[entry.name] = image_frame(entry, rig, sizes[entry.name], take)
    people = 1 if take.person is None else 3
    folder = networks(None, tell)
    hush(folder)
    detector = LiveDetector(folder, images, rate=rate, people=people, threads=threads)
    sigma = dict.fromkeys(images, _SIGMA)
    recording = Recording(np.zeros(1), rate, rig, sigma=sigma, up=take.up, name=take.name)
    return _Opened(recording, body, tuple(sources), detector)


def folder_of(take: Take) -> Path:
    """Where a session of a take leaves its files, unless told otherwise."""
    return take.path.with_name(f"{take.path.stem}-live")
