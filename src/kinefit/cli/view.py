"""`kinefit view`: an interactive 3D scene of a motion, a take, or both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from kinefit.motion import Motion
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations
    from kinefit.serving.access import Access
    from kinefit.viewers.show import ViewerContent

_EXAMPLES = """\b
Examples:
  kinefit view my_take-kinefit                  a folder of results, with its take
  kinefit view motion.npz --take take.toml      a motion with the cameras of its take
  kinefit view motion.npz other.npz             two motions in one scene
  kinefit view take.toml                        cameras and keypoints before anything is tracked
  kinefit view motion.npz --html scene.html     the scene as one HTML file
"""


@click.command(short_help="Show a motion, a take or a folder of results in 3D.", epilog=_EXAMPLES)
@click.argument("sources", metavar="SOURCE [OTHER]...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--take", type=click.Path(path_type=Path), help="Take file that gives cameras and markers.")
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="0: any free port.")
@click.option("--host", default="127.0.0.1", show_default=True, help="0.0.0.0 admits other computers.")
@_screen.token_option
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page in the browser.")
@_screen.hide_faces_option
@click.option("--cylinders", is_flag=True, help="Show the body's cylinders and bones instead of a skin.")
@click.option("--html", type=click.Path(path_type=Path), help="Write one self-contained page instead of serving it.")
@_screen.verbose_option
def view(
    sources: tuple[Path, ...], take: Path | None, port: int, host: str, token: str | None, browser: bool,
    cylinders: bool, html: Path | None, hide_faces: bool,
) -> None:
    """Show a motion, a take or a folder of results as a 3D scene in the browser.

    SOURCE is a motion file (.npz), a take file (.toml) or a folder that `kinefit track` wrote. Further motions are
    shown in the same scene. Ctrl-C ends the command.
    """
    from kinefit.cli._results import check_file
    from kinefit.serving.access import Access

    if html is not None:
        check_file(html, "--html")
    recording = gather(sources, take, hide_faces=hide_faces)
    if html is not None:
        _write(recording, html, cylinders)
    else:
        _serve(recording, port, Access(host, token), browser, cylinders)


def gather(sources: tuple[Path, ...], take_file: Path | None, *, hide_faces: bool = False) -> ViewerContent:
    """Read everything that is to be shown."""
    import numpy as np

    from kinefit.calibration.people.of_take import find_cameras
    from kinefit.preparing.faces import ensure_faces, shown_video
    from kinefit.readers.motion import read_motion
    from kinefit.readers.take.find import takes_in
    from kinefit.readers.take.load import load_observations
    from kinefit.viewers.pictures import CameraImages
    from kinefit.viewers.show import ViewerContent

    motions: list[Motion] = []
    beside: Path | None = None
    for source in sources:
        if source.suffix.lower() == ".toml":
            if take_file is not None:
                raise click.UsageError("Only one take can be shown: give one .toml file.")
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
        take = find_cameras(take_file, tell=_screen.note)
        seen = load_observations(take)
    elif found := _fitting(beside, motions[0].name):
        take, seen = found
    else:
        return ViewerContent(tuple(motions), name=motions[0].name)
    take = replace(take, hide_faces=take.hide_faces or hide_faces)
    cameras = {camera.name: camera for camera in seen.rig or ()}
    offsets = {entry.name: entry.time_offset for entry in take.cameras}
    for motion in motions:
        if motion.up != take.up:
            _screen.note(f"{motion.name} is rotated from up = {motion.up} to the take's up = {take.up}.")
    with _screen.bars() as step:
        if take.hide_faces and seen.videos:
            ensure_faces(take, step, _screen.note)
    videos = {name: shown_video(take, seen, name) for name in seen.videos}
    return ViewerContent(
        tuple(motions), rig=seen.rig, up=take.up, name=take.name, steps=np.arange(*seen.frames) / seen.rate,
        points=None if motions else _triangulated(take, seen),
        pictures=CameraImages(cameras, videos, seen.images, offsets, rate=seen.rate) if videos else None,
        markers=seen.markers, marker_offsets=tuple(entry.time_offset for entry in take.markers),
    )  # fmt: skip


def _fitting(file: Path | None, name: str) -> tuple[Take, Observations] | None:
    """The take beside a folder of results and what its sensors saw, where it can be read and is the motion's."""
    from kinefit.calibration.people.of_take import find_cameras
    from kinefit.errors import KinefitError
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations

    if file is None:
        return None
    try:
        take = read_take(file)
        if take.name != name:
            _screen.note(f"{file} is not shown: it is take '{take.name}', not '{name}'. Give another by --take.")
            return None
        take = find_cameras(take, tell=_screen.note)
        seen = load_observations(take)
    except KinefitError as error:
        _screen.note(f"The take of these results is not shown: {error}")
        return None
    _screen.note(f"Cameras are from the take {file}; --take gives another.")
    return take, seen


def _in_folder(folder: Path) -> tuple[Path, Path | None]:
    """The motion file in a folder of results, and the take that it probably came from."""
    from kinefit.errors import FileError

    file = folder / "motion.npz"
    if not file.is_file():
        remedy = "Give the folder that `kinefit track` wrote, or a motion file."
        raise FileError("this folder has no motion.npz", file=folder, remedy=remedy)
    name = folder.absolute().name
    places = [folder.absolute().with_name(f"{name.removesuffix('-kinefit')}.toml"), folder / "take" / "take.toml"]
    return file, next((place for place in places if place.is_file()), None)


def _triangulated(take: Take, seen: Observations) -> NDArray | None:
    """(F, K, 3) [m] keypoints of the person where two cameras agree; None, and a note, where there is nobody."""
    import numpy as np

    from kinefit.bodies import load_body
    from kinefit.errors import TrackingError
    from kinefit.multiview.association import choose_people, person_records
    from kinefit.multiview.followed import follow
    from kinefit.readers.take.pictures import TakePictures
    from kinefit.sensors.channels import make_channels
    from kinefit.sensors.points.triangulation import triangulated

    if seen.rig is None or not seen.keypoints:
        return None
    try:
        with TakePictures(take, seen) as pictures:
            keypoints = follow(seen.rig, seen.keypoints, take.person, images=pictures).keypoints
        people = choose_people(seen.rig, keypoints)
    except TrackingError as error:
        _screen.note(f"Only cameras are shown: {error.problem}.")
        return None
    sigma = [entry.sigma for entry in take.keypoints]
    channels = make_channels(load_body(take.body), seen.rig, person_records(keypoints, people), sigma)
    return triangulated(channels, np.arange(len(channels.uv)))


def _serve(recording: ViewerContent, port: int, access: Access, browser: bool, cylinders: bool) -> None:
    from kinefit.viewers.player import Player
    from kinefit.viewers.show import CYLINDERS, DEFAULT_LAYERS
    from kinefit.viewers.stage import open_server, quiet

    server = open_server(port, access, label=f"kinefit: {recording.name}")
    try:
        player = Player(server, recording, layers=CYLINDERS if cylinders else DEFAULT_LAYERS)
        player.tick(0.0)
        if port and server.get_port() != port:
            _screen.note(f"Port {port} is in use; port {server.get_port()} is used instead.")
        if access.warning:
            _screen.note(f"warning: {access.warning}")
        address = access.url(server.get_port())
        _screen.say(f"{recording.name}: {len(recording.times)} frames at {address}  (Ctrl-C ends)")
        if browser:
            click.launch(address)
        player.run()
    except KeyboardInterrupt:
        _screen.note("Closed.")
    finally:
        with quiet():
            server.stop()


def _write(recording: ViewerContent, html: Path, cylinders: bool) -> None:
    from kinefit.exporters.atomic import write_text
    from kinefit.viewers.page import page
    from kinefit.viewers.show import CYLINDERS, DEFAULT_LAYERS, Choice

    _screen.note("Rendering the scene ...")
    text, frames = page(recording, choice=Choice(CYLINDERS if cylinders else DEFAULT_LAYERS))
    write_text(html, text)
    thinned = f" of {len(recording.times)}" if frames < len(recording.times) else ""
    _screen.say(f"{html}: {frames}{thinned} frames, {len(text) / 1e6:.1f} MB; opens in any browser, offline")
