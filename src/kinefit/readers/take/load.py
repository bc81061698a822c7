"""Reading of everything that a take names, and the check that it fits together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinefit import observations
from kinefit._arguments import checked
from kinefit.bodies.motion import UP_AXES, MarkerEvent
from kinefit.errors import FileError, ObservationError, TakeError, command, located
from kinefit.geometry import se3
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.geometry.force_plates import ForcePlate
from kinefit.observations.clocks import frame_times, is_even, on_steps
from kinefit.readers.calibration.read import found_notes
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.landmarks.keypoint_sets import FACE_SET
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.landmarks.networks import read_sigma
from kinefit.readers.markers import read_markers
from kinefit.readers.plates import PlatesRead, read_force_file
from kinefit.readers.take import cameras as rigs
from kinefit.readers.take import entries
from kinefit.readers.take.checks import refuse_streams
from kinefit.readers.take.depth import depth_notes, load_depth
from kinefit.readers.take.kinds import KINDS, SensorKind
from kinefit.readers.take.points import load_clicks, load_skin
from kinefit.readers.videos.video import Video, common_frames

_MIN_COMMON_FRAMES = 10  # without a calibration: fewer tell neither clocks nor places of cameras
_LEVEL_COSINE = 0.5  # of a plate's normal and the take's vertical axis: ramps and stairs are within 60 degrees
_LEVEL = 45.0  # [deg] turned by less, the axis of a marker file that was vertical still is the nearest to it


@dataclass(frozen=True, eq=False)
class TakeSensor:
    """A sensor of a take: its kind, its entry and what it recorded."""

    kind: SensorKind
    entry: Any
    recording: observations.SensorRecording


@dataclass(frozen=True, eq=False)
class Observations:
    """Everything that the sensors of a take saw.

    Parameters
    ----------
    rate : float [Hz]
    frames : (start, stop)
        Steps of the common time that every camera's streams have; t = step / rate + first_time.
    rig : Rig or None
        The take's cameras, in its order, then its depth sensors; None where there are none.
    keypoints : tuple of Keypoints
        In the order of `take.keypoints`, all cut to `frames`, in the image frame of the calibration.
    markers : tuple of Markers
        In the order of `take.markers`, whole, at their own rates and on their own clocks.
    videos : {camera: Path}
    images : {camera: ImageFrame}
        How the video's image of each camera relates to the calibration's.
    depth : tuple of DepthVideo
        In the order of `take.depth`, whole, at their own rates; those whose files are images.
    clouds : tuple of CloudVideo
        Those whose files are points without order.
    skin : tuple of KeypointVideo
        In the order of `take.skin`: face and hands by colour, followed as their frames are asked for.
    clicks : tuple of ClickVideo
        Clicked joints, by camera, of cameras with clicks at `frames`.
    sensors : tuple of TakeSensor
        Of `take.sensors`, whole, at their own rates.
    notes : tuple of str
        What is worth saying: depth of another rate, frames that are missing.
    first_time : float [s]
        Time of step 0: that of the first frame in a take of markers alone, so that forces of the trial stay in step.
    static_markers : tuple of Markers or None
        Static trial of each of `markers`.
    plates : tuple of ForcePlate
        Of marker files and of `take.plates`, in the take's world and by its clock.
    events : tuple of MarkerEvent
        Of marker files, likewise.
    """

    rate: float
    frames: tuple[int, int]
    rig: Rig | None
    keypoints: tuple[observations.Keypoints, ...]
    markers: tuple[observations.Markers, ...]
    videos: dict[str, Path]
    images: dict[str, ImageFrame]
    depth: tuple[observations.DepthVideo, ...] = ()
    clouds: tuple[observations.CloudVideo, ...] = ()
    skin: tuple[observations.KeypointVideo, ...] = ()
    clicks: tuple[observations.ClickVideo, ...] = ()
    sensors: tuple[TakeSensor, ...] = ()
    notes: tuple[str, ...] = ()
    first_time: float = 0.0
    static_markers: tuple[observations.Markers | None, ...] = ()
    plates: tuple[ForcePlate, ...] = ()
    events: tuple[MarkerEvent, ...] = ()

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            return self.of_kind(entries.old_attribute(name, "Observations.of_kind"))

    @property
    def recordings(self) -> tuple[observations.SensorRecording, ...]:
        """Every recording with `at_step(step, rate)` and `frame(i)`: all but keypoints and markers."""
        of_kinds = (sensor.recording for sensor in self.sensors)
        return (*self.depth, *self.clouds, *of_kinds, *self.skin, *self.clicks)

    def of_kind(self, table: str) -> tuple[Any, ...]:
        """Recordings of a kind, in the order of the take."""
        return tuple(sensor.recording for sensor in self.sensors if sensor.kind.table == table)


def _load_sensors(cameras: rigs.TakeCameras) -> tuple[TakeSensor, ...]:
    """The sensors of all kinds of a take.

    Raises
    ------
    PluginError
        A kind of another distribution raises an error, or returns no recording of the sensor's name.
    """
    out = list[TakeSensor]()
    for table, listed in cameras.take.sensors.items():
        kind = KINDS.get(table)
        for k, entry in enumerate(listed):
            name = entries.sensor_name(kind.label or table, listed, k)
            valid = lambda r, name=name, kind=kind: (
                isinstance(r, observations.SensorRecording) and (r.sensor == name or kind.sensor is None)
            )
            with located(cameras.take.path, entries.title_of(table, entry)):
                what = f"a SensorRecording of the sensor '{name}'"
                out.append(TakeSensor(kind, entry, kind.call("read", entry, name, cameras, valid=valid, what=what)))
    return tuple(out)


@checked
def load_observations(take: entries.Take, *, exteriors: bool = True, calibrated: bool = True) -> Observations:
    """Read everything that a take names, and check that it fits together.

    Parameters
    ----------
    exteriors : bool
        Whether the calibration must state where cameras stand; without, one that it puts nowhere stands at the origin.
    calibrated : bool
        Whether confidences of detections are those of their network's calibration, where it has one.

    Raises
    ------
    TakeError
        A stream, of which nothing is recorded.
    CalibrationError
        A camera without calibration; an image of another size than the calibration's where the take does not state how.
    ObservationError
        Streams of different length, with each stream's; keypoints of as many frames as the video, and another rate;
        a rate of the take above its videos'; and what the readers of the files raise.
    FileError
        A file that is damaged.
    """
    refuse_streams(take)
    rig, found = rigs.read_rig(take, exteriors), found_notes(take.calibration)
    rates: dict[str, float] = {}
    streams: dict[str, NDArray] = {}  # (N,) [s] in the take
    clocks: dict[str, NDArray] = {}  # (N,) [s] of each camera's video, from its first frame
    sizes: dict[str, tuple[int, int]] = {}
    notes = []
    for entry in take.cameras:
        if entry.video is not None:
            with Video(entry.video, rate=take.rate) as video:
                stream = f"video {entry.name}"
                rates[stream], clocks[entry.name], sizes[entry.name] = video.rate, video.times, video.size
                streams[stream] = video.times + entry.time_offset
                notes += [f"{stream}: {video.unevenness}"] * bool(video.unevenness)
    listed = ", ".join(f"{stream} {rate:.6g} Hz" for stream, rate in rates.items())
    if take.rate and rates and take.rate > 1.001 * max(rates.values()):
        problem = f"a rate above that of every video: take {take.rate:.6g} Hz, {listed}"
        raise ObservationError(problem, file=take.path, remedy="Remove rate from [take]: the videos state theirs.")
    rate = take.rate or max(rates.values(), default=0.0)
    if not all(is_even(times, rate) for times in clocks.values()):
        notes.append(f"take {rate:.6g} Hz, {listed}: points are interpolated between frames")
    if rigs.is_alone(take) or (rigs.is_uncalibrated(take) and not exteriors):
        rig = Rig(tuple(rigs.assumed_camera(e, sizes.get(e.name, e.size), take) for e in take.cameras))
    elif rigs.is_uncalibrated(take):
        remedy = f"They are found from the people in view: {command('track', take.path)}, or find_cameras in Python."
        raise TakeError("cameras that are not calibrated yet", file=take.path, remedy=remedy)
    images = {entry.name: rigs.image_frame(entry, rig, sizes.get(entry.name), take) for entry in take.cameras}
    of_cameras = rigs.TakeCameras(take, rig, images, clocks, rates, streams, sizes)
    keypoints, markers = [], tuple(_read_markers(entry, entry.file) for entry in take.markers)
    static_markers = tuple(_read_markers(e, e.static) if e.static else None for e in take.markers)
    for number, source in enumerate(take.keypoints):
        read, times = _read_keypoints(source, of_cameras, number, calibrated=calibrated)
        stream = f"keypoints {source.camera}" + f" ({source.format})" * (len(take.keypoints) > len(take.cameras))
        if times is not clocks.get(source.camera):
            rates[stream] = read.rate
        streams[stream] = times + of_cameras.offset(source.camera)
        keypoints.append((read, streams[stream]))
    plates = [plate.shifted(e.time_offset) for e, m in zip(take.markers, markers) for plate in m.plates]
    events = [replace(one, time=one.time + e.time_offset) for e, m in zip(take.markers, markers) for one in m.events]
    of_files = entries.read_each(take, take.plates, partial(_read_plates, up=take.up))
    plates += [plate for read in of_files for plate in read.plates]
    notes += [f"[[plate]]: {text}" for read in of_files for text in read.notes]
    if len(once := _different(plates)) < len(plates):
        notes.append(f"{len(plates) - len(once)} force plates are named twice and count once")
    plates = once
    deep = entries.read_each(take, take.depth, partial(load_depth, cameras=of_cameras))
    depth = tuple(video for video in deep if isinstance(video, observations.DepthVideo))
    clouds = tuple(video for video in deep if isinstance(video, observations.CloudVideo))
    sensors = _load_sensors(of_cameras)
    skin = entries.read_each(take, take.skin, partial(load_skin, cameras=of_cameras))
    fastest, clicks = of_cameras.fastest, load_clicks(of_cameras)
    recordings: tuple[observations.SensorRecording, ...] = (*depth, *clouds, *(sensor.recording for sensor in sensors))
    marked = [(f"[[markers]] {k}", e.time_offset + m.times) for k, (e, m) in enumerate(zip(take.markers, markers), 1)]
    if not (streams or clicks or markers or recordings):
        remedy = "Add a video to a [[camera]], or [[keypoints]]: `kinefit init` proposes a take."
        raise TakeError("the cameras have no video and no keypoints", file=take.path, remedy=remedy)
    first_time = 0.0
    own = [*(recording.rate for recording in (*recordings, *clicks)), *(m.rate for m in markers)]
    rate = fastest or own[0]
    if streams:
        overlap = rigs.is_uncalibrated(take) or bool(found)
        frames = common_frames(streams, rate, take.frames, overlap=overlap, file=take.path)
        if rigs.is_uncalibrated(take) and frames[1] - frames[0] < _MIN_COMMON_FRAMES:
            shortest = min(streams, key=lambda stream: len(streams[stream]))
            problem = f"all cameras together saw {frames[1] - frames[0]} frames; the shortest is {shortest}, with "
            problem += f"{len(streams[shortest])}"
            raise ObservationError(
                problem, file=take.path, place=shortest,
                remedy="Remove that video, or use a longer one: finding the cameras takes two seconds or more.",
            )  # fmt: skip
        common, whole = (frames[1] - frames[0]) / rate, max(float(np.ptp(t)) for t in streams.values()) + 1.0 / rate
        if overlap and not take.frames and whole > 1.1 * common:
            notes.append(f"all cameras saw {common:.3g} s, the longest {whole:.3g} s")
    elif recordings or clicks:
        dense = [recording for recording in recordings if not isinstance(recording, observations.LineVideo)]
        frames = take.frames or _span(dense or recordings or clicks, rate)
    else:
        first_time = float(min(times[0] for _, times in marked))
        shown = [m.trimmed() for m in markers]
        starts = [e.time_offset + m.first_time for e, m in zip(take.markers, shown)]
        seen = min(starts), max(start + len(m) / m.rate for start, m in zip(starts, shown))
        notes += [note for m, all_of in zip(shown, markers) for note in m.notes[len(all_of.notes) :] if not take.frames]
        frames, marked = take.frames or (round((seen[0] - first_time) * rate), round((seen[1] - first_time) * rate)), []
    kinds = {observations.LineVideo: "lines of camera ", observations.KeypointVideo: "keypoints of camera "}
    kinds |= dict.fromkeys((observations.DepthVideo, observations.CloudVideo), "depth ")
    others = [(f"{kinds.get(type(r), '')}{r.sensor}", r.times) for r in (*recordings, *skin)]
    clocks_of_plates = [(plate.name, plate.times - first_time) for plate in plates]
    _check_times([*others, *marked, *clocks_of_plates], frames, rate, take)
    notes += [
        f"{place}: {Path(m.source).name} begins at {times[0]:.6g} s of the take, by its own clock and time_offset"
        for (place, times), m in zip(marked, markers) if m.first_time
    ]  # fmt: skip
    notes += [f"{r.sensor}: {note}" for r in recordings for note in getattr(r, "notes", ())]
    notes += [*(n for m in markers for n in m.notes), *depth_notes((*depth, *clouds), rate)]
    cameras = [rig[entry.name] for entry in take.cameras if rig is not None]
    cameras += [video.camera for video in depth if video.camera is not None]
    return Observations(
        rate=rate, frames=frames, rig=Rig(tuple(cameras)) if cameras else None,
        markers=markers, static_markers=static_markers, plates=_named_apart(plates), events=tuple(events),
        keypoints=tuple(_cut(*k, rate, frames, entry) for k, entry in zip(keypoints, take.keypoints)),
        videos={e.name: e.video for e in take.cameras if e.video is not None}, images=images,
        depth=depth, clouds=clouds, sensors=sensors, skin=skin,
        clicks=tuple(c for c in clicks if _within(np.rint(c.times * rate), [frames]).any()),
        notes=(*notes, *found, *rigs.what_is_assumed(take)),
        first_time=first_time,
    )


def _span(recordings: Sequence[observations.SensorRecording], rate: float) -> tuple[int, int]:
    """Steps from the first frame of any recording to the last."""
    first, last = min(r.times[0] for r in recordings), max(r.times[-1] for r in recordings)
    return round(float(first) * rate), round(float(last) * rate) + 1


def _check_times(
    recordings: Sequence[tuple[str, NDArray]], frames: tuple[int, int], rate: float, take: entries.Take
) -> None:
    """Refuse what was not recorded at the time of the rest; place and times (F,) [s] of each."""
    for place, times in recordings:
        first, last = float(times[0]), float(times[-1])
        if round(last * rate) < frames[0] or round(first * rate) >= frames[1]:
            raise ObservationError(
                f"its frames are from {first:.3g} to {last:.3g} s, the steps [{frames[0]}, {frames[1]}] of the take "
                f"from {frames[0] / rate:.3g} to {(frames[1] - 1) / rate:.3g} s", file=take.path, place=place,
                remedy=f"Correct its rate or frames, or add {frames[0] / rate - first:.6g} s to its time_offset: "
                "then both begin together.",
            )  # fmt: skip


def _read_keypoints(
    source: entries.KeypointsEntry, cameras: rigs.TakeCameras, number: int, *, calibrated: bool
) -> tuple[observations.Keypoints, NDArray]:
    """Keypoints of a camera, and the times (F,) [s] of their frames from the first on."""
    place = f"[[keypoints]] {number + 1}, camera {source.camera}"
    take, image, rates = cameras.take, cameras.images[source.camera], cameras.rates
    offset, clock = cameras.offset(source.camera), cameras.clocks.get(source.camera)
    if source.format == "detect":
        file = source.file or detections_file(take.path, source.camera)
        found = read_detections(file)
        frame, face = rigs.stated_frame(image, "video", "keypoints"), source.set == FACE_SET
        seen = found.keypoints(source.camera, image_frame=frame, time_offset=offset, face=face)
        sigma = read_sigma(Path(found.network)) if calibrated and found.network and not face else None
        seen = seen if sigma is None else sigma.calibrated(seen, len(found.names))
        return seen, frame_times(len(found), found.rate, clock if found.times is None else found.times)
    with located(take.path, place):
        frame = rigs.stated_frame(image, source.frame, "keypoints")
        rate = rigs.stated_rate(source.rate or rates.get(f"video {source.camera}") or take.rate)
    assert source.file is not None
    takes_set = source.set and source.format in (*entries.COUNTED, *entries.NAMED, "freemocap")
    options: dict[str, Any] = {"keypoint_set": source.set} if takes_set else {}
    options |= {"names": source.names} if source.names else {}
    record = read_keypoints(
        source.file, format=source.format, camera=source.camera, rate=rate, image_frame=frame, time_offset=offset,
        **options,
    )
    times = frame_times(len(record), rate, clock)
    if times is clock and source.rate and not is_even(times, source.rate):
        own = rates[f"video {source.camera}"]
        raise ObservationError(
            f"the keypoints have {source.rate:.6g} Hz, and the video of as many frames {own:.6g} Hz", file=take.path,
            place=place, remedy="Remove rate from [[keypoints]]: they take the times of the video's frames.",
        )
    hands_unwanted = source.set == "MEDIAPIPE_33" and record.keypoint_set == "MEDIAPIPE_75"
    return record.first_points("MEDIAPIPE_33", observations.MEDIAPIPE_33) if hands_unwanted else record, times


def _read_markers(entry: entries.MarkersEntry, file: Path) -> observations.Markers:
    """The marker recording of an entry, or its static trial, in the take's world."""
    markers = read_markers(file, unit=entry.unit)
    markers = markers.sided(entry.sides) if entry.sides else markers
    if not (any(entry.shift) or any(entry.turn)):
        return markers
    T, up = entry.T_world_file, markers.up if max(abs(v) for v in entry.turn) < _LEVEL else None
    plates = tuple(plate.moved(T) for plate in markers.plates)
    return replace(markers, positions=se3.apply(T, markers.positions), up=up, plates=plates)


def _read_plates(entry: entries.PlateEntry, up: str) -> PlatesRead:
    """Force plates of a file of their own, in the take's world and by its clock."""
    if entry.file.suffix.lower() == ".c3d":
        markers = read_markers(entry.file)
        found = PlatesRead(markers.plates, tuple(text for text in markers.notes if "force plate" in text))
    else:
        found = read_force_file(entry.file)
    if not found.plates:
        why, remedy = "; ".join(found.notes), "Name the C3D of the trial, or its ground forces as .mot."
        problem = f"no force plates in this file{why and f': {why}'}"
        raise FileError(problem, file=entry.file, remedy=remedy)
    moved = tuple(plate.moved(entry.T_world_file).shifted(entry.time_offset) for plate in found.plates)
    for plate in moved:
        if plate.normal @ UP_AXES[up] < _LEVEL_COSINE:
            axis = "xyz"[int(np.argmax(np.abs(plate.normal)))]
            problem = f"{plate.name} bears its load along {axis}, and the take's up is {up}"
            remedy = 'Turn it: turn = [90.0, 0.0, 0.0] takes a file that is y up into a take with up = "z".'
            raise FileError(problem, file=entry.file, remedy=remedy)
    return PlatesRead(moved, found.notes)


def _different(plates: Sequence[ForcePlate]) -> list[ForcePlate]:
    """Each plate once: of two with the same corners and forces the first."""
    out = list[ForcePlate]()
    for plate in plates:
        same = (np.array_equal(plate.force, one.force) and np.allclose(plate.corners, one.corners) for one in out)
        out += [] if any(same) else [plate]
    return out


def _named_apart(plates: Sequence[ForcePlate]) -> tuple[ForcePlate, ...]:
    """Plates of several files, each with a name of its own."""
    once = len({plate.name for plate in plates}) == len(plates)
    return tuple(plates if once else (replace(p, name=f"plate {k}") for k, p in enumerate(plates, 1)))


def _cut(
    keypoints: observations.Keypoints, times: NDArray, rate: float, frames: tuple[int, int],
    entry: entries.KeypointsEntry,
) -> observations.Keypoints:  # fmt: skip
    """Keypoints at the steps [start, stop) of the common time, with what their entry states of ranges of steps."""
    if is_even(times, rate):
        begin = frames[0] - round(keypoints.time_offset * rate)
        rows = slice(begin, begin + frames[1] - frames[0])
        cut = replace(keypoints.rows(rows, keypoints.time_offset + begin / rate), rate=rate)
    else:
        cut = on_steps(keypoints, times, rate, frames)
    steps = np.arange(*frames)
    if entry.swapped:
        cut = cut.exchanged(_within(steps, entry.swapped))
    unused = _within(steps, entry.excluded)
    if entry.frames is not None:
        unused |= ~_within(steps, [entry.frames])
    return cut.without(unused) if unused.any() else cut


def _within(steps: NDArray, ranges: Sequence[tuple[int, int]]) -> NDArray:
    """(F,) bool: steps (F,) that are in one of some ranges [start, stop)."""
    return np.any([(steps >= start) & (steps < stop) for start, stop in ranges] or [np.zeros(len(steps), bool)], axis=0)
