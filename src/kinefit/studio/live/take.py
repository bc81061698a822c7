"""Make a live session of a take: its streams, or a replay of its recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinefit._threads import cores
from kinefit.bodies import Body, load_body
from kinefit.errors import CalibrationError, TakeError, command, located
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.run import tracker_of
from kinefit.fitting.tracking.take_recording import posed_start, recording_of
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.images.depth_scene import background_model
from kinefit.images.detectors.box_detector import Models
from kinefit.markers.take.takes import with_names
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.readers import load_observations, read_depth, read_motion
from kinefit.readers.take.cameras import assumed_camera, image_frame, is_alone, read_rig
from kinefit.readers.take.checks import streams_of
from kinefit.readers.take.depth import stated_camera
from kinefit.readers.take.entries import CameraEntry, DepthEntry, Take
from kinefit.studio.live.cameras import CameraStream, LiveDetector, SessionClock, VideoReplay
from kinefit.studio.live.folders import DepthFolderStream, ImageFolderStream, KeypointFolderStream, Replay
from kinefit.studio.live.people import LivePerson, LiveSize
from kinefit.studio.live.record import SeenRecord
from kinefit.studio.live.session import LiveSession, Receiver, Source
from kinefit.takes.missing import find_cameras, last_found
from kinefit.takes.preparing.detecting import Tell, hushed, networks
from kinefit.takes.preparing.take import warn
from kinefit.takes.track import settings_of, trial_of, with_bands_of


def live_session(
    take: Take, receivers: Sequence[Receiver] = (), *, speed: float = 1.0, threads: int | None = None,
    folder: Path | None = None, tell: Tell = warn,
) -> LiveSession:
    """Make a session of a take: live if its sensors have a `stream`, else a replay at its own speed.

    The built-in detector runs on videos without keypoints. Cameras of a recording without calibration are found first,
    as by `find_cameras`.

    Parameters
    ----------
    receivers : of the poses
    speed : of a replay; 0: as fast as possible, without drops
    threads : of the detector; default: all cores
    folder : for a take of the person's detections; None writes none
    tell : called with messages for the user

    Raises
    ------
    TakeError
        Streams of some cameras only; streams together with sensors that need a recording; a choice of person that needs
        the whole recording.
    KinefitError
        As opening and reading.
    """
    placed = last_found(take) if streams_of(take) else find_cameras(take, tell=tell)
    take = replace(take, cameras=placed.cameras, calibration=placed.calibration)
    body = with_bands_of(take, load_body(take.body) if take.start is None else read_motion(take.start).body)
    threads = threads or cores()
    if streams_of(take):
        opened = opened_streams(take, body, threads, tell)
    elif take.cameras and not (take.keypoints or take.other_sensors):
        opened = _videos(take, body, speed, threads, tell)
    else:
        opened = _recorded(take, body, speed, tell)
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


def _recorded(take: Take, body: Body, speed: float, tell: Tell) -> Opened:
    """Replay of a take's recording, step by step."""
    seen = with_names(take, load_observations(take))
    if seen.plates:
        use = f"{command('track', take.path)} takes contacts, forces and the mass from them"
        tell(f"Force plates have no part in a live session: {use}.")
    recording, body = recording_of(take, replace(seen, keypoints=()), body)
    return Opened(recording, body, (Replay(recording, seen.keypoints, speed=speed),))


def _videos(take: Take, body: Body, speed: float, threads: int, tell: Tell) -> Opened:
    """Videos with the built-in detector."""
    entries = [entry for entry in take.cameras if entry.video is not None]
    if not entries:
        remedy = "Write stream or video into its [[camera]] entries."
        raise TakeError("no camera of the take has a stream or video", file=take.path, remedy=remedy)
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
    """Default folder for the files of a session of a take."""
    return take.path.with_name(f"{take.path.stem}-live")


_DEFAULT_RATE = 30.0  # [Hz] of streams
_MAX_BACKGROUND_IMAGES = 30  # of an empty scene: more add nothing


@dataclass(frozen=True, eq=False)
class Opened:
    """The parts of a session."""

    recording: Recording
    body: Body
    sources: tuple[Source, ...]
    detector: LiveDetector | None = None


def opened_streams(take: Take, body: Body, threads: int, tell: Tell) -> Opened:
    """Open every stream of a take.

    Raises
    ------
    TakeError, CalibrationError
        An unknown image size, or an unknown pose of a camera or depth sensor.
    KinefitError
        As opening streams.
    """
    rig, clock, rate = read_rig(take), SessionClock(), take.rate or _DEFAULT_RATE
    cameras = [entry for entry in take.cameras if entry.stream is not None]
    if cameras:
        sizes = {entry.name: stream_size(entry, rig, take) for entry in cameras}
        images = [camera_source(entry, sizes[entry.name], take, clock) for entry in cameras]
        seen = with_detector(take, body, images, sizes, rate, threads, tell)
    else:
        empty = Recording(np.zeros(1), rate, Rig(()), up=take.up, name=take.name)
        seen = Opened(empty, body, ())
    sources, sigma = list(seen.sources), dict(seen.recording.sigma)
    placed = [] if rig is None else [rig[entry.name] for entry in take.cameras]
    rig_of_all = list(seen.recording.rig) if cameras else placed
    for keypoints in take.keypoints:
        assert keypoints.stream is not None
        if rig is None:
            remedy = 'Add [calibration] with file = "..."; for a single camera, stream its images instead.'
            raise TakeError("keypoints need a calibration", file=take.path, place=keypoints.camera, remedy=remedy)
        entry = next(camera for camera in take.cameras if camera.name == keypoints.camera)
        frame = image_frame(entry, rig, None, take) if keypoints.frame == "video" else None
        sources.append(KeypointFolderStream(
            entry.name, keypoints.stream, clock, keypoint_set=keypoints.set or "BODY_25B", rate=rate, image=frame
        ))  # fmt: skip
        sigma[entry.name] = keypoints.sigma
    backgrounds = {}
    for depth in take.depth:
        assert depth.stream is not None
        camera = _depth_camera(depth, rig, take)
        rig_of_all.append(camera)
        near, far = depth.range or (0.0, np.inf)
        sources.append(DepthFolderStream(
            depth.name, depth.stream, camera.size, clock, unit=depth.unit, near=near, far=far
        ))  # fmt: skip
        sigma[depth.name] = depth.sigma
        if depth.background is not None:
            video = read_depth(depth.background, sensor=depth.name, unit=depth.unit)
            empty_scene = [video.frame(i).depth for i in range(min(len(video), _MAX_BACKGROUND_IMAGES))]
            backgrounds[depth.name] = background_model(empty_scene, share=0.5)
    recording = replace(
        seen.recording, rig=Rig(tuple(rig_of_all)), sigma=sigma, backgrounds=backgrounds,
        on_body=tuple(depth.name for depth in take.depth if depth.on_body), start=posed_start(take, body, (0, 1)),
    )  # fmt: skip
    return Opened(recording, body, tuple(sources), seen.detector)


def with_detector(
    take: Take, body: Body, sources: Sequence[Source], sizes: dict[str, tuple[int, int]], rate: float, threads: int,
    tell: Tell,
) -> Opened:  # fmt: skip
    """Sources of images with the built-in detector; sizes (width, height) [px], rate [Hz].

    Raises
    ------
    TakeError
        Cameras without calibration.
    """
    rig = read_rig(take)
    if is_alone(take):
        rig = Rig((assumed_camera(take.cameras[0], sizes.get(take.cameras[0].name), take),))
    if rig is None:
        raise TakeError("the cameras need a calibration", file=take.path, remedy='Add [calibration] with file = "...".')
    images = dict[str, ImageFrame]()
    for entry in take.cameras:
        if entry.name in sizes:
            images[entry.name] = image_frame(entry, rig, sizes[entry.name], take)
    people = 1 if take.person is None else 3
    files = networks(None, tell)
    with hushed():
        Models(files.folder, landmarks=files.landmarks)
    detector = LiveDetector(files, images, rate=rate, people=people, threads=threads)
    sigma = dict.fromkeys(images, KEYPOINT_SIGMA)
    own = Rig(tuple(rig[entry.name] for entry in take.cameras))
    recording = Recording(np.zeros(1), rate, own, sigma=sigma, up=take.up, name=take.name)
    return Opened(recording, body, tuple(sources), detector)


def stream_size(entry: CameraEntry, rig: Rig | None, take: Take) -> tuple[int, int]:
    """(width, height) [px] of a camera's image; TakeError where neither entry nor calibration states it."""
    size = entry.size or (rig[entry.name].size if rig is not None else None)
    if size is None:
        remedy = "Write size = [width, height] into its [[camera]], or add [calibration]."
        raise TakeError("the size of its image is unknown", file=take.path, place=f"camera {entry.name}",
                        remedy=remedy)  # fmt: skip
    return size


def camera_source(entry: CameraEntry, size: tuple[int, int], take: Take, clock: SessionClock) -> Source:
    """Source of the images (size [px]) of one camera: a folder or a stream; FileError if it cannot be opened."""
    assert entry.stream is not None
    folder = take.path.parent / entry.stream
    if folder.is_dir():
        return ImageFolderStream(entry.name, folder, size, clock)
    return CameraStream(entry.name, entry.stream, size, clock)


def _depth_camera(entry: DepthEntry, rig: Rig | None, take: Take) -> Camera:
    """The sensor's stated camera; errors name the take and the sensor."""
    remedy = "Write intrinsics = [fx, fy, cx, cy] and size = [width, height] [px], or add [calibration]."
    with located(take.path, f"depth {entry.name}"):
        camera = stated_camera(entry, entry.size, rig)
        if camera is None:
            raise CalibrationError("its intrinsics are unknown", remedy=remedy)
    return camera
