"""Who may open the app, and what its addresses give."""

import http.client
import os
import re
import signal
import sys
from contextlib import closing
from importlib import resources
from urllib.parse import quote, urlsplit

import pytest
from click.testing import CliRunner
from tests.studio.app.running import TOKEN, running_app

from kinefit.cli import main

pytest.importorskip("nicegui")


@pytest.fixture(scope="module")
def app(tmp_path_factory, drawn_take):
    folder = tmp_path_factory.mktemp("session")
    (folder / "page.html").write_text("<p>a report</p>")
    with running_app(folder) as (process, address):
        yield process, address, folder


def asked(address, path, **headers):
    """Status, headers and body of a request to the app's port."""
    at = urlsplit(address)
    with closing(http.client.HTTPConnection(at.hostname, at.port, timeout=30)) as connection:
        connection.request("GET", path, headers={"Host": f"localhost:{at.port}", **headers})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


def test_only_with_the_token_from_this_host_and_these_pages(app):
    _, address, _ = app
    own = f"/{TOKEN}/"
    assert asked(address, own)[0] == 200
    assert asked(address, "/")[0] == asked(address, "/another-token-0000/")[0] == 403
    assert asked(address, own, Host="attacker.example:80")[0] == 421
    assert asked(address, own, Origin="http://attacker.example")[0] == 403
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
               "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}  # fmt: skip
    socket = f"/{TOKEN}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    assert asked(address, socket, Origin="http://attacker.example", **upgrade)[0] == 403
    assert asked(address, socket.replace(TOKEN, "another-token-0000"), **upgrade)[0] == 403


def test_where_a_page_was_led_from(app):
    _, address, _ = app
    own = f"/{TOKEN}/"
    assert [asked(address, own, **{"Sec-Fetch-Site": site})[0] for site in ("none", "same-origin")] == [200, 200]
    for site in ("cross-site", "same-site", "", "None"):
        for path in (own, f"{own}take?path=x", f"{own}image/first?path=x"):
            assert asked(address, path, **{"Sec-Fetch-Site": site})[0] == 403


def test_every_answer_has_a_policy_and_only_the_pages_own_scripts_run(app):
    _, address, _ = app
    for path in (f"/{TOKEN}/", f"/{TOKEN}/gone", f"/{TOKEN}/file?path=x", "/"):
        _, headers, body = asked(address, path)
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'") and "frame-ancestors 'self'" in policy
        assert "'unsafe-inline'" not in policy.partition("style-src")[0] and "connect-src 'self';" in policy
        assert headers["x-frame-options"] == "SAMEORIGIN" and headers["referrer-policy"] == "same-origin"
        nonce = re.search("'nonce-([^']+)'", policy)[1]
        assert body.count(b"<script") == body.count(f'<script nonce="{nonce}"'.encode())
    first, second = (asked(address, f"/{TOKEN}/")[1]["content-security-policy"] for _ in range(2))
    assert first != second


def test_properties_are_values_in_all_pages():
    pages = resources.files("kinefit.studio.app") / "pages"
    texts = {file.name: file.read_text() for file in pages.iterdir() if file.name.endswith(".py")}
    assert len(texts) > 6 and [name for name, text in texts.items() if re.search(r"props\(\s*f", text)] == []


def test_no_image_before_the_choice_of_faces(app, drawn_take):
    _, address, _ = app
    video = quote(str(drawn_take.with_name("cam01.mp4")))
    assert asked(address, f"/{TOKEN}/image/first?path={video}")[0] == 403


def test_no_page_of_a_recording_before_the_choice_of_faces(app):
    _, address, folder = app
    assert asked(address, f"/{TOKEN}/file?path={quote(str(folder / 'page.html'))}")[0] == 403


def test_a_folder_that_is_not_there(tmp_path):
    done = CliRunner().invoke(main, ["app", str(tmp_path / "gone"), "--no-browser"])
    assert done.exit_code == 2


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C of another process")
def test_ctrl_c_ends_it(tmp_path):
    with running_app(tmp_path) as (process, _):
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(20) in (0, 130)
