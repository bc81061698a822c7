"""Gather what a viewer shows of a motion, a take or a folder of results."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import KinefitError, ObservationError, TrackingError
from kinefit.fitting.multiview.followed import follow
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.readers.motion import find_motion, read_motion
from kinefit.readers.take.file import Take, read_take, takes_in
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.take.videos import TakePictures
from kinefit.sensors.points.views import triangulated
from kinefit.sensors.settings import TrackSettings
from kinefit.studio.viewers.show import ViewerContent
from kinefit.studio.viewers.stage import CameraImages
from kinefit.takes.batch.corrections import OUTDATED, is_outdated
from kinefit.takes.batch.results import Step, silent
from kinefit.takes.missing import find_cameras
from kinefit.takes.preparing.detecting import Tell
from kinefit.takes.preparing.faces import ensure_faces, shown_video


def gather(
    sources: Sequence[Path], take_file: Path | None = None, *, hide_faces: bool = False, step: Step = silent,
    tell: Tell = silent,
) -> ViewerContent:  # fmt: skip
    """Read everything that is to be shown.

    Parameters
    ----------
    sources : motion files, folders of results, or one take file
    take_file : whose cameras and markers are shown; default: the take next to the first folder of results
    hide_faces : whether all faces are hidden in the cameras' images; a take may say so, too

    Raises
    ------
    KinefitError
        A file is missing or invalid, or two takes are given.
    """
    motions: list[Motion] = []
    beside: Path | None = None
    for source in sources:
        if source.suffix.lower() == ".toml":
            if take_file is not None:
                raise ObservationError("two take files", file=source, remedy="Give one: one take is shown at a time.")
            take_file = source
            continue
        if source.is_dir() and not (source / "motion.npz").is_file() and takes_in(source) and take_file is None:
            take_file = source
            continue
        if source.is_dir():
            source, there = _in_folder(source)
            beside = beside or there
        motions.append(read_motion(source))
    if take_file is not None:
        take = find_cameras(take_file, step, tell)
        seen = load_observations(take)
    elif found := _fitting(beside, motions[0].name, tell):
        take, seen = found
    else:
        return ViewerContent(tuple(motions), name=motions[0].name)
    return content_of(motions, replace(take, hide_faces=take.hide_faces or hide_faces), seen, step=step, tell=tell)


def content_of(
    motions: Sequence[Motion], take: Take, seen: Observations, *, step: Step = silent, tell: Tell = silent,
    find: bool = True,
) -> ViewerContent:  # fmt: skip
    """Motions of a take, with its cameras, images and markers; without motions with its triangulated keypoints.

    Where faces are hidden, they are looked for first; without `find`, images in which they are unknown are blurred.
    """
    cameras = {camera.name: camera for camera in seen.rig or ()}
    offsets = {entry.name: entry.time_offset for entry in take.cameras}
    for motion in motions:
        if is_outdated(motion.provenance, take.path):
            tell(f"{motion.name}: {OUTDATED}.")
        if motion.up != take.up:
            tell(f"{motion.name} is rotated from up = {motion.up} to the take's up = {take.up}.")
    if take.hide_faces and seen.videos and find:
        ensure_faces(take, step, tell)
    rig, videos = seen.rig, {name: shown_video(take, seen, name, find=find) for name in seen.videos}
    if any(not has_same_cameras(motion, take) for motion in motions):
        tell("Cameras and images are left out: the calibration changed since the motion was computed. Track it again.")
        rig, videos = None, {}
    return ViewerContent(
        tuple(motions), rig=rig, up=take.up, name=take.name,
        steps=np.arange(*seen.frames) / seen.rate + seen.first_time,
        points=None if motions else _triangulated(take, seen, tell),
        pictures=CameraImages(cameras, videos, seen.images, offsets, rate=seen.rate) if videos else None,
        markers=seen.markers, marker_offsets=tuple(entry.time_offset for entry in take.markers),
    )  # fmt: skip


def has_same_cameras(motion: Motion, take: Take) -> bool:
    """Whether a take's calibration is still the file with which the motion was computed, as far as the motion says."""
    stated = motion.provenance.get("calibration", {}).get("sha256")
    if stated is None or take.calibration is None or not take.calibration.file.is_file():
        return True
    return bool(stated == hashlib.sha256(take.calibration.file.read_bytes()).hexdigest())


def _fitting(file: Path | None, name: str, tell: Tell) -> tuple[Take, Observations] | None:
    """The take beside a folder of results and what its sensors saw, where it can be read and is the motion's."""
    if file is None:
        return None
    try:
        take = read_take(file)
        if take.name != name:
            tell(f"{file} is not shown: it is take '{take.name}', not '{name}'. Give another by --take.")
            return None
        take = find_cameras(take, tell=tell)
        seen = load_observations(take)
    except KinefitError as error:
        tell(f"The take of these results is not shown: {error}")
        return None
    tell(f"Cameras are from the take {file}; --take gives another.")
    return take, seen


def _in_folder(folder: Path) -> tuple[Path, Path | None]:
    """The motion file in a folder of results, and the take that it probably came from."""
    file = find_motion(folder)
    name = folder.absolute().name
    places = [folder.absolute().with_name(f"{name.removesuffix('-kinefit')}.toml"), folder / "take" / "take.toml"]
    return file, next((place for place in places if place.is_file()), None)


def _triangulated(take: Take, seen: Observations, tell: Tell) -> NDArray | None:
    """(F, K, 3) [m] keypoints of the person where two cameras agree; None, and a note, without a person."""
    if seen.rig is None or not seen.keypoints:
        return None
    sigma = [entry.sigma for entry in take.keypoints]
    try:
        with TakePictures(take, seen) as pictures:
            people = follow(seen.rig, seen.keypoints, images=pictures).people
        person = Recording.of_keypoints(seen.rig, seen.keypoints, sigma=sigma, person=take.person, people=people)
    except TrackingError as error:
        tell(f"Only cameras are shown: {error.problem}.")
        return None
    channels = channels_of(person, load_body(take.body), TrackSettings())
    return triangulated(channels, np.arange(len(channels.uv)))
