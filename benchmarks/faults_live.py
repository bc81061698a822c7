"""Live against foreign pages, bad wishes, floods and port probes: `python -m benchmarks.faults_live`.

The person is simulated, every connection goes to this computer's own loopback, and all of it ends within some 20 s.
"""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
import sys
import threading
import time

from tests.studio.live.refused import REFUSED
from tests.studio.serving.asking import GONE, is_let_in, port_of, ws
from tests.studio.serving.flooding import FLOODS
from tests.studio.serving.probing import break_off, probe
from websockets.sync.client import connect

from benchmarks.figures import amount, figure
from benchmarks.live import RATE, Loop
from kinefit.bodies.motion import UP_AXES
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.simulation.recordings import warm_keypoints
from kinefit.studio.live.receivers.websocket import WebSockets
from kinefit.studio.live.session import LiveSession
from kinefit.studio.serving.access import Access
from kinefit.studio.viewers.clicks import ClickPage
from kinefit.studio.viewers.stage import open_server, quiet

PAGE, HOST = {"Origin": "https://evil.example"}, {"host": "evil.example"}


@contextlib.contextmanager
def session(host="127.0.0.1"):
    """A session without end at 30 Hz: its server, and the thread it runs in."""
    motion = cut(squat_and_wave(), 0, 60)
    rig = studio_rig(motion)
    tracker = Tracker(motion.body, rig, rate=RATE, up=UP_AXES[motion.up])
    live = LiveSession(tracker, [Loop(simulate_keypoints(motion, rig, "BODY_25B"), 100_000, RATE)])
    server = WebSockets(0, host=host, ask=live.ask)
    live.receivers = (server,)
    thread = threading.Thread(target=live.run, daemon=True)
    thread.start()
    try:
        yield server, thread
    finally:
        live.stop()
        thread.join(10.0)


def answer(client, wish):
    """Kind of the answer to a wish; "" where the connection ends."""
    try:
        client.send(wish)
        kinds = (json.loads(client.recv(5.0))["type"] for _ in range(200))
        return next(kind for kind in kinds if kind in ("done", "refused"))
    except (*GONE, TimeoutError, StopIteration):
        return ""


def ways_in(pages):
    """{way: whether one of the servers lets somebody in by it}; the first page is the session's."""
    bare, sockets = pages[0].rsplit("/", 2)[0], [ws(page) for page in pages]
    if not all(is_let_in(url) for url in [*pages, *sockets, ws(bare)]):
        raise RuntimeError("a server that lets nobody in is no measure")
    sockets.append(ws(bare))
    with session("0.0.0.0") as (wide, _), connect(ws(bare)) as client:
        wide_bare = wide.url.rsplit("/", 2)[0]
        return {
            "a foreign page's WebSocket": any(is_let_in(url, **PAGE) for url in sockets),
            "a foreign page's request": any(is_let_in(url, **PAGE) for url in pages),
            "a foreign host's WebSocket": any(is_let_in(url, **HOST) for url in sockets),
            "a foreign host's page": any(is_let_in(url, **HOST) for url in pages),
            "a wish without token": answer(client, b'{"stop": true}') == "done" or is_let_in(f"{ws(bare)}/{'x' * 24}"),
            "all networks": is_let_in(ws(wide_bare)) or is_let_in(wide_bare),
        }


def harmful(wishes):
    """Wishes that end a session, or are not refused."""
    found, left = [], list(wishes)
    while left:
        with session() as (server, thread), connect(ws(server.url)) as client:
            while left:
                wish = left.pop(0)
                if answer(client, wish) != "refused" or not client.recv(5.0) or not thread.is_alive():
                    found.append(wish[:60])
                    break
    return found


def received(client, seconds):
    """Packets that a client gets in so many seconds."""
    with contextlib.suppress(TimeoutError):
        while True:  # what waited
            client.recv(0.0)
    count, until = 0, time.monotonic() + seconds
    while time.monotonic() < until:
        client.recv(5.0)
        count += 1
    return count


def beside_floods(server, seconds):
    """{kind of flood: packets of a second client beside it, and of the same client just before}."""
    url, counts = ws(server.url), {}
    for kind in FLOODS:
        words = [sys.executable, "-m", "tests.studio.serving.flooding", str(server.port), server.access.token, kind]
        with connect(url) as client:
            alone = received(client, seconds)
            with subprocess.Popen([*words, str(seconds + 1.0)], stdout=subprocess.PIPE) as flooder:
                flooder.stdout.readline()
                counts[kind] = received(client, seconds), alone
                flooder.kill()
    return counts


def run() -> None:
    warm_keypoints()
    records, handler, access = [], logging.Handler(), Access()
    handler.emit = records.append
    logging.getLogger().addHandler(handler)
    clicks = ClickPage({"cam01": b""}, ["knee"], lambda told: "")
    with quiet():
        view = open_server(0, access)
    with session() as (server, _):
        ways = ways_in([server.url, clicks.url, access.url(view.get_port())])
        print("let in by: " + (", ".join(way for way, is_open in ways.items() if is_open) or "no way"))
        figure("faults_live_let_in", float(sum(ways.values())), "of 6 ways", "== 0")
        for port in (server.port, view.get_port(), port_of(clicks.url)):
            probe(port)
        with connect(ws(server.url)) as client:
            break_off(client.socket)
        counts = beside_floods(server, amount(1.0, 0.5))
        print("packets beside a flood of " + ", ".join(f"{kind} {n} ({m} before)" for kind, (n, m) in counts.items()))
        beside, alone = map(sum, zip(*counts.values()))
        figure("faults_live_beside_flood", beside / alone, "", ">= 0.95")
    found = harmful([wish for wish, _ in REFUSED])
    print(f"wishes that do harm: {found or 'none'}")
    figure("faults_live_sessions_ended", float(len(found)), f"of {len(REFUSED)} wishes", "== 0")
    tracebacks = [record for record in records if record.exc_info and record.name != "websockets.client"]
    figure("faults_live_tracebacks", float(len(tracebacks)), "", "== 0")
    logging.getLogger().removeHandler(handler)
    clicks.close()
    with quiet():
        view.stop()


if __name__ == "__main__":
    run()
