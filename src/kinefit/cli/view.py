"""`kinefit view`: an interactive 3D scene of a motion, a take, or both."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen
from kinefit.errors import FileError, printable

if TYPE_CHECKING:
    from kinefit.studio.serving.access import Access
    from kinefit.studio.viewers.show import ViewerContent


@click.command(short_help="Show a motion, a take or a folder of results in 3D.", epilog="""\b
Examples:
  kinefit view my_take-kinefit                  a folder of results, with its take
  kinefit view motion.npz --take take.toml      a motion with the cameras of its take
  kinefit view motion.npz other.npz             two motions in one scene
  kinefit view take.toml                        cameras and keypoints before anything is tracked
  kinefit view motion.npz --html scene.html     the scene as one HTML file
""")  # fmt: skip
@click.argument("sources", metavar="SOURCE [OTHER]...", nargs=-1, required=True, type=_screen.PATH)
@click.option("--take", type=_screen.PATH, help="Take file that gives cameras and markers.")
@click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="0: any free port.")
@_screen.host_option
@_screen.token_option
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page in the browser.")
@_screen.hide_faces_option
@click.option("--cylinders", is_flag=True, help="Show the body's cylinders and bones instead of a skin.")
@click.option("--html", type=_screen.PATH, help="Write one self-contained page instead of serving it.")
@_screen.verbose_option
@_screen.gathered("access", "kinefit.studio.serving.access:Access", "host", "token")
def view(
    sources: tuple[Path, ...], take: Path | None, port: int, access: Access, browser: bool, cylinders: bool,
    html: Path | None, hide_faces: bool,
) -> None:
    """Show a motion, a take or a folder of results as a 3D scene in the browser.

    SOURCE is a motion file (.npz), a take file (.toml) or a folder that `kinefit track` wrote. Further motions are
    shown in the same scene. Ctrl-C ends the command.
    """
    from kinefit.studio.viewers.viewed import gather

    if html is not None:
        _screen.check_file(html, "--html")
    with _screen.bars() as step:
        recording = gather(sources, take, hide_faces=hide_faces, step=step, tell=_screen.note)
    if html is not None:
        _write(recording, html, cylinders)
    else:
        _serve(recording, port, access, browser, cylinders)


def _serve(recording: ViewerContent, port: int, access: Access, browser: bool, cylinders: bool) -> None:
    from kinefit.studio.viewers.player import Player
    from kinefit.studio.viewers.show import CYLINDERS, DEFAULT_LAYERS
    from kinefit.studio.viewers.stage import open_server, quiet

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
            click.launch(access.opening(server.get_port()))
        player.run()
    except KeyboardInterrupt:
        _screen.note("Closed.")
    finally:
        with quiet():
            server.stop()


def _write(recording: ViewerContent, html: Path, cylinders: bool) -> None:
    from kinefit._files import write_text
    from kinefit.studio.viewers.show import CYLINDERS, DEFAULT_LAYERS, Choice, page

    _screen.note("Rendering the scene ...")
    text, frames = page(recording, choice=Choice(CYLINDERS if cylinders else DEFAULT_LAYERS))
    write_text(html, text)
    thinned = f" of {len(recording.times)}" if frames < len(recording.times) else ""
    _screen.say(f"{html}: {frames}{thinned} frames, {len(text) / 1e6:.1f} MB; opens in any browser, offline")


@click.command("app", short_help="Do all of it in a page of the browser.", epilog="""\b
Examples:
  kinefit app                       recordings in this folder and below it
  kinefit app my_sessions           recordings in another folder
""")  # fmt: skip
@click.argument("folder", type=_screen.PATH, default=".")
@click.option("--port", type=click.IntRange(0, 65535), default=8090, show_default=True, help="0: any free one.")
@_screen.token_option
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page.")
@_screen.verbose_option
@_screen.gathered("access", "kinefit.studio.serving.access:Access", "token")
def app(folder: Path, port: int, access: Access, browser: bool) -> None:
    """Do all of it in a page of the browser: from a folder of videos to a report, corrections and exports.

    FOLDER is where your recordings are, and where dropped videos are put. Only this computer can open the page; nothing
    is sent anywhere. Everything it makes is a file that the commands make, too. Closing the page stops nothing; Ctrl-C
    here ends the app, and what is computed goes on from there the next time. Needs the extra `app`:
    pip install 'kinefit[app]'.
    """
    from kinefit.studio.app.server import serve

    root = folder.absolute()
    if not root.is_dir():
        raise FileError("no such folder", file=folder, remedy="Name the folder with your recordings.")

    if printable(root) != str(root):
        problem = "the name of this folder is not UTF-8, as the addresses of pages are"
        raise FileError(problem, file=folder, remedy="Rename it.")

    def opened(port: int) -> None:
        _screen.say(f"kinefit app at {access.url(port)}  (Ctrl-C ends)")
        if browser:
            click.launch(access.opening(port))

    serve(root, port, access, opened)
