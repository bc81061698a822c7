"""`kinefit live`: track a person in real time and send each pose to its receivers."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.errors import command

if TYPE_CHECKING:
    from kinefit.studio.live.receivers.websocket import WebSockets
    from kinefit.studio.live.session import LiveSession, Receiver


def _address(ctx: click.Context, parameter: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Host and port of "HOST:PORT"."""
    if value is None:
        return None
    host, _, port = value.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise click.BadParameter(f"{value!r} is not HOST:PORT; write it as localhost:39539")
    return host.strip("[]"), int(port)


def _page(page: bool, port: int, host: str, token: str | None) -> Callable[..., WebSockets] | None:
    """What serves the page, given its title and what it may ask the session; None without a page."""
    from kinefit.studio.live.receivers.websocket import WebSockets

    return partial(WebSockets, port, host=host, token=token) if page else None


def _receivers(vmc: tuple[str, int] | None, lsl: str | None) -> Callable[[float, str], Iterator[Receiver]]:
    """What opens the receivers that are asked for, one after the other, given the rate [Hz] and the vertical axis."""
    from kinefit.studio.live.receivers import websocket

    def opened(rate: float, up: str) -> Iterator[Receiver]:
        if vmc is not None:
            yield websocket.Vmc(*vmc, up=up)
        if lsl is not None:
            yield websocket.Lsl(lsl, rate=rate)

    return opened


@click.command(short_help="Track a person live, and stream the poses.", epilog="""\b
Examples:
  kinefit live take.toml                       a recorded take, replayed in real time
  kinefit live studio.toml --vmc localhost:39539      cameras with streams; moves an avatar
  kinefit live studio.toml --lsl kinefit --out session1
  kinefit live take.toml --json - --no-page | my_program
""")  # fmt: skip
@click.argument("take", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Folder of the session.  [default: TAKE-live]")
@click.option("--page/--no-page", default=True, show_default=True, help="Serve a web page, and poses by WebSocket.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="0: any free port.")
@_screen.host_option
@_screen.token_option
@click.option("--vmc", callback=_address, metavar="HOST:PORT", help="Send poses to an avatar by VMC over OSC.")
@click.option("--lsl", metavar="NAME", help="Send angles and joints to the Lab Streaming Layer (extra `lsl`).")
@click.option("--json", "lines", metavar="FILE", help="Write each pose as a line of JSON; - is standard output.")
@click.option(
    "--speed", type=click.FloatRange(0.0), default=1.0, show_default=True,
    help="Speed factor of a replayed take; 0: as fast as tracking allows, without dropped frames.",
)
@click.option("--seconds", type=click.FloatRange(0.0, min_open=True), help="Session length.  [default: until Ctrl-C]")
@click.option(
    "--record/--no-record", default=True, show_default=True, help="Write the motion and a take into the folder."
)
@_screen.verbose_option
@_screen.gathered("serve", _page, "page", "port", "host", "token")
@_screen.gathered("send", _receivers, "vmc", "lsl")
def live(
    take: Path, out: Path | None, serve: Callable[..., WebSockets] | None,
    lines: str | None, send: Callable[[float, str], Iterator[Receiver]], speed: float, seconds: float | None,
    record: bool,
) -> None:
    """Track a person live, and stream the poses.

    TAKE is a take file. Sensors with a `stream` are read live: a webcam's number, an address such as rtsp://..., or a
    folder to which another program adds images, depth images or keypoints. A take without streams is replayed in real
    time. Frames that arrive faster than they can be tracked are dropped and counted, never queued.

    The printed address opens a page that shows the person. Programs get the poses there by WebSocket: docs/live.md
    describes the protocol and who may connect. The folder gets the motion, for `kinefit export` and `kinefit view`. If
    the built-in detector ran, it also gets a take, for `kinefit track`, which fits and smooths the whole session.
    """
    from kinefit.readers.take.file import read_take
    from kinefit.simulation.recordings import warm_depth, warm_keypoints
    from kinefit.studio.live.receivers.websocket import JsonLines
    from kinefit.studio.live.record import MotionRecord
    from kinefit.studio.live.take import folder_of, live_session

    entry = read_take(take)
    quiet = lines == "-"
    receivers: list[Receiver] = []
    folder = (out or folder_of(entry)) if record else None
    session: LiveSession = live_session(entry, speed=speed, folder=folder, tell=_screen.note)
    try:
        rate, up = session.tracker.rate, entry.up
        receivers += [] if lines is None else [JsonLines(lines)]
        receivers.extend(send(rate, up))  # one after the other: what is open is closed below
        kept = None if folder is None else MotionRecord(folder, rate=rate, up=up, name=entry.name)
        if kept is not None:
            receivers.append(kept)
        if serve is not None:  # the last: once it has a pose, its thread takes turns with who is still to get it
            served = serve(title=entry.name, ask=session.ask)
            receivers.append(served)
            if served.access.warning:
                _screen.note(f"warning: {served.access.warning}")
            _screen.say(f"page and poses at {served.url}", stderr=quiet)
        warm_depth() if entry.depth or entry.stereo else warm_keypoints()
    except BaseException:  # Ctrl-C while it warms up, too
        for receiver in receivers:
            receiver.close()
        session.close()
        raise
    session.receivers = tuple(receivers)
    with _ctrl_c(session):
        session.run(seconds)
    _tell(session, kept, quiet)


@contextmanager
def _ctrl_c(session: LiveSession) -> Iterator[None]:
    """Ctrl-C ends the session in order."""

    def stop(*_: Any) -> None:
        session.stop()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _tell(session: LiveSession, kept: Any, quiet: bool) -> None:
    """What became of it."""
    dropped, came = sum(session.inbox.dropped.values()), sum(session.inbox.came.values())
    steps = f"{session.processed} steps, person tracked in {session.found}"
    _screen.say(f"{steps}; {dropped} of {came} frames dropped", stderr=quiet)
    if session.latencies:
        ms = sorted(session.latencies)
        text = f"{1000 * ms[len(ms) // 2]:.1f} ms, 99 % within {1000 * ms[int(0.99 * (len(ms) - 1))]:.1f} ms"
        _screen.say(f"from frame to pose: median {text}", stderr=quiet)
    if session.size is not None:
        _screen.say(f"note: {session.size.outcome or 'the session ended before the size of the person was estimated'}",
                    stderr=quiet)  # fmt: skip
    if kept is not None:
        path = "person not found: no motion is written" if kept.path is None else str(kept.path)
        _screen.say(path, stderr=quiet)
    if session.seen is not None and session.seen.path is not None:
        _screen.say(f"{session.seen.path}: fit all of it by {command('track', session.seen.path)}", stderr=quiet)
