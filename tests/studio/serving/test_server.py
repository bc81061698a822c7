"""A page and WebSockets on loopback: who floods is cut off, who reads is served, probes print nothing."""

import logging
import socket
import urllib.error
import urllib.request

import pytest
from tests.studio.serving.probing import break_off, probe
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import connect

from kinefit.errors import ExportError
from kinefit.exporters.report.page import inline_policy
from kinefit.studio.serving.access import Access
from kinefit.studio.serving.server import MAX_FRAMES_AT_ONCE, MAX_MESSAGE_BYTES, Allowance, Page, PageServer, listen

PAGES = {"/": Page(b"hello", policy=inline_policy(["x"], [])), "/a.js": Page(b"1", "text/javascript")}
LIMIT = 5000  # messages that a flooder of a test sends at most


class Echo(PageServer):
    page = staticmethod(PAGES.get)

    async def talk(self, connection):
        async for message in connection:
            await connection.send(f"{message} {connection.has_token}")


@pytest.fixture
def server():
    server = Echo(Access(readers=True))
    yield server
    server.close()


def ws(server, token=True):
    return server.url.replace("http", "ws", 1) if token else f"ws://localhost:{server.port}"


def test_pages_have_a_policy_and_are_not_kept(server):
    with urllib.request.urlopen(server.url, timeout=10) as answer:
        assert answer.read() == b"hello" and answer.headers["X-Content-Type-Options"] == "nosniff"
        policy = answer.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'") and "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy and answer.headers["Cache-Control"] == "no-store"
    with urllib.request.urlopen(f"{server.url}a.js", timeout=10) as answer:
        assert answer.headers["Content-Type"] == "text/javascript"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{server.url}../a.js", timeout=10)


@pytest.mark.parametrize(("header", "value", "status"), [
    ("Host", "evil.example", 421), ("Origin", "https://evil.example", 403), ("Origin", "null", 403),
])  # fmt: skip
def test_foreign_pages_get_neither_page_nor_poses(server, header, value, status):
    with pytest.raises(urllib.error.HTTPError, match=str(status)):
        urllib.request.urlopen(urllib.request.Request(server.url, headers={header: value}), timeout=10)
    key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
    host = value if header == "Host" else f"localhost:{server.port}"
    origin = f"Origin: {value}\r\n" if header == "Origin" else ""
    for path in ("/", f"/{server.access.token}"):
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
            client.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}\r\n{origin}Connection: Upgrade\r\n"
                           f"Upgrade: websocket\r\n{key}\r\n\r\n".encode())  # fmt: skip
            assert client.recv(100).startswith(f"HTTP/1.1 {status} ".encode())


def test_the_token_is_told_to_who_talks(server):
    for token in (True, False):
        with connect(ws(server, token)) as client:
            client.send("a")
            assert client.recv(10) == f"a {token}"
    with connect(ws(server), origin=f"http://localhost:{server.port}") as client:
        client.send("a")
        assert client.recv(10) == "a True"
    for address in (ws(server, False), f"{ws(server, False)}/wrong"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(address, origin=f"http://localhost:{server.port}").close()


def test_a_server_for_all_networks_needs_the_token():
    server = Echo(Access("0.0.0.0", readers=True))
    try:
        with pytest.raises(InvalidStatus, match="403"):
            connect(ws(server, False))
        with connect(ws(server)) as client:
            client.send("a")
            assert client.recv(10) == "a True"
    finally:
        server.close()


def test_who_floods_is_cut_off_and_another_is_served(server):
    with connect(ws(server)) as quiet:
        for message in (lambda c, k: c.send(str(k)), lambda c, k: c.ping(str(k)), lambda c, k: c.send(["a"] * 200)):
            with connect(ws(server, False)) as flooder, pytest.raises((ConnectionClosed, TimeoutError)):
                for k in range(LIMIT):
                    message(flooder, k)
                while True:
                    flooder.recv(10)
            assert flooder.protocol.close_code in (1008, 1006)  # told, or cut off before it could be
            quiet.send("still here")
            assert quiet.recv(10) == "still here True"


def test_a_message_that_is_too_long_closes_its_connection(server):
    with connect(ws(server), max_size=None) as client, pytest.raises(ConnectionClosed, match="1009"):
        client.send("x" * (MAX_MESSAGE_BYTES + 1))
        client.recv(10)


def test_connections_that_are_opened_too_fast_wait_and_nobody_else_does(server, capfd, caplog):
    with connect(ws(server)) as quiet:
        waiting = [socket.create_connection(("127.0.0.1", server.port), timeout=10) for _ in range(80)]
        for k in range(20):
            quiet.send(f"{k}")
            assert quiet.recv(10) == f"{k} True"
        with connect(ws(server), open_timeout=30) as late:
            late.send("late")
            assert late.recv(10) == "late True"
        for client in waiting:
            client.close()
    assert capfd.readouterr() == ("", "") and not [record for record in caplog.records if record.exc_info]


def test_more_connections_than_may_be_open_are_closed(server, monkeypatch):
    monkeypatch.setattr("kinefit.studio.serving.server._MAX_CONNECTIONS", 2)
    with connect(ws(server)) as one, connect(ws(server)) as two:
        with pytest.raises((OSError, EOFError, WebSocketException)):
            connect(ws(server))
        for client in (one, two):
            client.send("a")
            assert client.recv(10) == "a True"


def test_an_allowance_grows_again_and_no_further_than_it_was():
    allowance = Allowance(3, 2.0)
    assert [allowance.take(10.0) for _ in range(4)] == [True, True, True, False]
    assert [allowance.take(10.4), allowance.take(10.5), allowance.take(10.6)] == [False, True, False]
    assert [allowance.take(99.0) for _ in range(4)] == [True, True, True, False]
    assert MAX_FRAMES_AT_ONCE > 16  # as many requests as a page has sensors


def test_probes_print_nothing(server, capfd, caplog):
    with caplog.at_level(logging.INFO):
        probe(server.port)
        with connect(ws(server)) as client:
            client.send("a")
            break_off(client.socket)
        with connect(ws(server)) as client:
            client.send("b")
            assert client.recv(10) == "b True"
    server.close()
    assert capfd.readouterr() == ("", "")
    assert not [record for record in caplog.records if record.exc_info and record.name != "websockets.client"]


@pytest.mark.parametrize("host", ["no.such.host.invalid", "a" * 70 + ".invalid", "203.0.113.7"])
def test_a_host_that_is_none_is_told(host):
    with pytest.raises(ExportError, match="server cannot start at"):
        Echo(Access(host))


def test_a_server_that_is_closed_does_nothing(server):
    server.close()
    server.call(print, "never")
    server.close()


def test_a_one_time_address_goes_on_to_the_page(server):
    address = server.access.opening(server.port)
    with urllib.request.urlopen(address, timeout=10) as answer:
        assert answer.headers["Refresh"] == f"0; url=/{server.access.token}/" and b"hello" not in answer.read()
        assert answer.headers["Cache-Control"] == "no-store"
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(address, timeout=10)


def test_a_port_in_use_gives_the_next():
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with listen("127.0.0.1", port, search=True) as found:
            assert found.getsockname()[1] != port
        with pytest.raises(ExportError, match=f"127.0.0.1:{port} .*in use"):
            listen("127.0.0.1", port)
