"""From a take file to a live session: its streams, or what it recorded, replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from kinefit._threads import cores
from kinefit.bodies import Body, load_body
from kinefit.errors import TakeError
from kinefit.identification.take.named import with_names
from kinefit.live.cameras import SessionClock, VideoReplay
from kinefit.live.people import LivePerson
from kinefit.live.replay import Replay
from kinefit.live.seen import SeenRecord
from kinefit.live.session import LiveSession, Receiver
from kinefit.live.sizing import LiveSize
from kinefit.live.streams import Opened, opened_streams, with_detector
from kinefit.preparing.detecting import Tell
from kinefit.preparing.take import warn
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import load_observations
from kinefit.readers.take.one_camera import is_alone
from kinefit.readers.take.streams import streams_of
from kinefit.tracking.run import tracker_of
from kinefit.tracking.takes.take import settings_of, trial_of
from kinefit.tracking.takes.take_recording import recording_of


def live_session(
    take: Take, receivers: Sequence[Receiver] = (), *, speed: float = 1.0, threads: int | None = None,
    folder: Path | None = None, tell: Tell = warn,
) -> LiveSession:
    """A session of a take: live where its sensors have a `stream`, else what it recorded at its own speed.

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
    threads = threads or cores()
    if streams_of(take):
        opened = opened_streams(take, body, threads, tell)
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
    sigma = {k: v for k, v in tracker.sigma.items() if k in recording.rig.names}
    size = None if sized or not (opened.detector or take.keypoints) else LiveSize(
        body, recording.rig, sigma=sigma, settings=settings, height=take.height, up=take.up
    )  # fmt: skip
    seen = None
    if folder is not None and opened.detector is not None:
        seen = SeenRecord(folder, take, recording.rig, rate=recording.rate, alone=is_alone(take))
    return LiveSession(
        tracker, opened.sources, receivers, detector=opened.detector, person=LivePerson(recording.rig, take.person),
        size=size, seen=seen, name=take.name,
    )  # fmt: skip


def _recorded(take: Take, body: Body, speed: float) -> Opened:
    """Everything that a take recorded, step by step."""
    seen = with_names(take, load_observations(take))
    recording, body = recording_of(take, replace(seen, keypoints=()), body)
    return Opened(recording, body, (Replay(recording, seen.keypoints, speed=speed),))


def _videos(take: Take, body: Body, speed: float, threads: int, tell: Tell) -> Opened:
    """Videos, looked through as they are shown."""
    entries = [entry for entry in take.cameras if entry.video is not None]
    if not entries:
        remedy = "Give its cameras a stream or a video."
        raise TakeError("cameras, but nothing that they saw", file=take.path, remedy=remedy)
    clock, sources = SessionClock(), []
    for entry in entries:
        assert entry.video is not None
        sources.append(VideoReplay(
            entry.name, entry.video, clock, rate=take.rate, offset=entry.time_offset, speed=speed, frames=take.frames
        ))  # fmt: skip
    sizes = {source.name: source.size for source in sources}
    rate = min(source.rate for source in sources)
    return with_detector(take, body, sources, sizes, rate, threads, tell)


def folder_of(take: Take) -> Path:
    """Where a session of a take leaves its files, unless told otherwise."""
    return take.path.with_name(f"{take.path.stem}-live")
