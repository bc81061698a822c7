"""Streams of a take as sources: cameras, folders of depth images and keypoints; what a session is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import CalibrationError, TakeError
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.images.depth_scene import background_model
from kinefit.live.cameras import CameraStream, SessionClock
from kinefit.live.detecting import LiveDetector
from kinefit.live.folders import DepthFolderStream, ImageFolderStream, KeypointFolderStream
from kinefit.live.session import Source
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.preparing.detecting import Tell, hush, networks
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.take.depth import stated_camera
from kinefit.readers.take.file import CameraEntry, DepthEntry, Take
from kinefit.readers.take.load import image_frame, read_rig
from kinefit.readers.take.one_camera import assumed_camera, is_alone
from kinefit.tracking.recording import Recording
from kinefit.tracking.takes.take_recording import posed_start

_RATE = 30.0  # [Hz] of streams that nothing states a rate of
_EMPTY = 30  # images of an empty scene that are looked at: more add nothing


@dataclass(frozen=True, eq=False)
class Opened:
    """What a session is made of."""

    recording: Recording
    body: Body
    sources: tuple[Source, ...]
    detector: LiveDetector | None = None


def opened_streams(take: Take, body: Body, threads: int, tell: Tell) -> Opened:
    """Every stream of a take, as it comes.

    Raises
    ------
    TakeError, CalibrationError
        Nothing tells an image's size, or where a camera or depth sensor stands.
    KinefitError
        What opening streams raises.
    """
    rig, clock, rate = read_rig(take), SessionClock(), take.rate or _RATE
    cameras = [entry for entry in take.cameras if entry.stream is not None]
    if cameras:
        sizes = {entry.name: _size(entry, rig, take) for entry in cameras}
        images = [_camera(entry, sizes[entry.name], take, clock) for entry in cameras]
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
            remedy = 'Add [calibration] with file = "..."; one camera alone needs a stream of its images.'
            raise TakeError("keypoints without calibration", file=take.path, place=keypoints.camera, remedy=remedy)
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
            empty_scene = [video.frame(i).depth for i in range(min(len(video), _EMPTY))]
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
    sigma = dict.fromkeys(images, KEYPOINT_SIGMA)
    own = Rig(tuple(rig[entry.name] for entry in take.cameras))
    recording = Recording(np.zeros(1), rate, own, sigma=sigma, up=take.up, name=take.name)
    return Opened(recording, body, tuple(sources), detector)


def _size(entry: CameraEntry, rig: Rig | None, take: Take) -> tuple[int, int]:
    """[px] of a camera's image."""
    size = entry.size or (rig[entry.name].size if rig is not None else None)
    if size is None:
        remedy = "Write size = [width, height], or a calibration."
        raise TakeError("nothing tells the size of its image", file=take.path, place=f"camera {entry.name}",
                        remedy=remedy)  # fmt: skip
    return size


def _camera(entry: CameraEntry, size: tuple[int, int], take: Take, clock: SessionClock) -> Source:
    """The images of one camera, as they come."""
    assert entry.stream is not None
    folder = take.path.parent / entry.stream
    if folder.is_dir():
        return ImageFolderStream(entry.name, folder, size, clock)
    return CameraStream(entry.name, entry.stream, size, clock)


def _depth_camera(entry: DepthEntry, rig: Rig | None, take: Take) -> Camera:
    """The sensor's camera as it is stated; errors name the take and the sensor."""
    remedy = "Write intrinsics = [fx, fy, cx, cy] and size = [width, height] [px], or add [calibration]."
    try:
        camera = stated_camera(entry, entry.size, rig)
        if camera is None:
            raise CalibrationError("nothing states its intrinsics", remedy=remedy)
    except (CalibrationError, TakeError) as error:
        place = f"depth {entry.name}"
        raise type(error)(error.problem, file=error.file or take.path, place=place, remedy=error.remedy) from error
    return camera
