"""Who may open the app, and what its addresses give."""

import http.client
import os
import signal
import sys
from contextlib import closing
from urllib.parse import quote, urlsplit

import pytest
from click.testing import CliRunner
from tests.app.running import TOKEN, running_app

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
