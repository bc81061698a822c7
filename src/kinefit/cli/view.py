"""`kinefit view`: an interactive 3D scene of a motion, a take, or both."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen

if TYPE_CHECKING:
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
    from kinefit.batch.viewed import gather
    from kinefit.cli._results import check_file
    from kinefit.serving.access import Access

    if html is not None:
        check_file(html, "--html")
    with _screen.bars() as step:
        recording = gather(sources, take, hide_faces=hide_faces, step=step, tell=_screen.note)
    if html is not None:
        _write(recording, html, cylinders)
    else:
        _serve(recording, port, Access(host, token), browser, cylinders)


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
            click.launch(access.opening(server.get_port()))
        player.run()
    except KeyboardInterrupt:
        _screen.note("Closed.")
    finally:
        with quiet():
            server.stop()


def _write(recording: ViewerContent, html: Path, cylinders: bool) -> None:
    from kinefit._files import write_text
    from kinefit.viewers.show import CYLINDERS, DEFAULT_LAYERS, Choice, page

    _screen.note("Rendering the scene ...")
    text, frames = page(recording, choice=Choice(CYLINDERS if cylinders else DEFAULT_LAYERS))
    write_text(html, text)
    thinned = f" of {len(recording.times)}" if frames < len(recording.times) else ""
    _screen.say(f"{html}: {frames}{thinned} frames, {len(text) / 1e6:.1f} MB; opens in any browser, offline")
