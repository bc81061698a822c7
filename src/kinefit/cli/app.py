"""`kinefit app`: all of it in a page of the browser, without a typed word."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen


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
def app(folder: Path, port: int, token: str | None, browser: bool) -> None:
    """Do all of it in a page of the browser: from a folder of videos to a report, corrections and exports.

    FOLDER is where your recordings are, and where dropped videos are put. Only this computer can open the page; nothing
    is sent anywhere. Everything it makes is a file that the commands make, too. Closing the page stops nothing; Ctrl-C
    here ends the app, and what is computed goes on from there the next time. Needs the extra `app`:
    pip install 'kinefit[app]'.
    """
    from kinefit.app.server import serve
    from kinefit.errors import FileError, printable
    from kinefit.serving.access import Access

    root = folder.absolute()
    if not root.is_dir():
        raise FileError("no such folder", file=folder, remedy="Name the folder with your recordings.")

    if printable(root) != str(root):
        problem = "the name of this folder is not UTF-8, as the addresses of pages are"
        raise FileError(problem, file=folder, remedy="Rename it.")
    access = Access(token=token)

    def opened(port: int) -> None:
        _screen.say(f"kinefit app at {access.url(port)}  (Ctrl-C ends)")
        if browser:
            click.launch(access.opening(port))

    serve(root, port, access, opened)
