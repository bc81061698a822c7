"""Who is let in: own addresses, own pages, the token; and who is not."""

import pytest
from websockets.datastructures import Headers

from kinefit.errors import ExportError
from kinefit.studio.serving.access import Access, Admission, Refusal

PORT = 8765
TOKEN = "0123456789abcdef-_ABCDEF"


def ask(access, path=f"/{TOKEN}/", *, host=f"localhost:{PORT}", origin=None, upgrade=True, address="127.0.0.1"):
    """Status of a request, 200 for one that may go on without the token, 201 with it."""
    headers = Headers()
    for name, values in (("Host", host), ("Origin", origin), ("Upgrade", "websocket" if upgrade else None)):
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None:
                headers[name] = value
    found = access.check(path, headers, address, PORT)
    return found.status.value if isinstance(found, Refusal) else 200 + found.has_token


@pytest.fixture
def local():
    return Access(token=TOKEN, readers=True)


@pytest.mark.parametrize("host", ["localhost:8765", "127.0.0.1:8765", "[::1]:8765", "LOCALHOST:8765"])
def test_own_hosts_are_served(local, host):
    assert ask(local, host=host) == 201
    assert ask(local, host=host, origin=f"http://{host}") == 201


@pytest.mark.parametrize("host", [
    "evil.example:8765", "evil.example", "localhost", "localhost:80", "localhost:8766", "localhost.evil.example:8765",
    "127.0.0.1.evil.example:8765", "localhost:8765:8765", "a@localhost:8765", "localhost:8765/", "", None, "[::1",
    "192.168.1.5:8765", "localhost:99999", ("localhost:8765", "localhost:8765"), ("localhost:8765", "evil.example"),
])  # fmt: skip
def test_foreign_hosts_are_not(local, host):
    assert ask(local, host=host) == 421
    assert ask(local, "/", host=host) == 421


@pytest.mark.parametrize("origin", [
    "https://evil.example", "http://evil.example", "null", "", "http://localhost", "https://localhost:8765",
    "http://localhost:3000", "http://127.0.0.1:8765", ("http://localhost:8765", "https://evil.example"),
])  # fmt: skip
def test_pages_of_other_origins_are_not_let_in_even_with_the_token(local, origin):
    assert ask(local, origin=origin) == ask(local, "/", origin=origin) == 403


def test_without_the_token_a_local_program_may_read_and_nobody_else(local):
    assert ask(local, "/") == 200
    assert ask(local, "/", origin=f"http://localhost:{PORT}") == 403  # a browser
    assert ask(local, "/", upgrade=False) == 403  # the page
    assert ask(Access(token=TOKEN), "/") == 403  # a server that nobody reads without it
    assert ask(Access("0.0.0.0", TOKEN, readers=True), "/") == 403  # open to the network


@pytest.mark.parametrize("path", [
    f"/{TOKEN[:-1]}/", f"/{TOKEN}x/", f"/{TOKEN.lower()}/", "/x/", f"/x/{TOKEN}/", f"/?token={TOKEN}x", "/ü\udcff/",
])  # fmt: skip
def test_a_wrong_token_is_refused(path):
    for access in (Access(token=TOKEN), Access("0.0.0.0", TOKEN)):
        assert ask(access, path) == 403


def test_the_path_behind_the_token_is_handed_on(local):
    headers = Headers(Host=f"localhost:{PORT}")
    for path, rest in (("", "/"), ("/", "/"), ("/a/b.js?x=1", "/a/b.js"), ("?x", "/")):
        assert local.check(f"/{TOKEN}{path}", headers, "127.0.0.1", PORT) == Admission(rest, True)


def test_a_server_for_all_networks_answers_to_numbers_and_its_own_name(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "Studio")
    access = Access("0.0.0.0", TOKEN)
    for host in ("192.168.1.5:8765", "[fe80::1]:8765", "studio:8765", "studio.local:8765", "localhost:8765"):
        assert ask(access, host=host, address="192.168.1.5") == 201
    for host in ("evil.example:8765", "studio.evil.example:8765", "192.168.1.5"):
        assert ask(access, host=host, address="192.168.1.5") == 421
    named = Access("studio.lab", TOKEN)
    assert ask(named, host="studio.lab:8765", address="192.168.1.5") == 201


def test_loopback_is_told_from_networks():
    for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"):
        assert Access(host).is_local and Access(host).warning is None
    for host in ("0.0.0.0", "", "::", "192.168.1.5", "studio.lab", "localhost.evil.example"):
        assert not Access(host).is_local and "open to the network" in Access(host).warning


def test_addresses_have_the_token():
    assert Access(token=TOKEN).url(80) == Access("0.0.0.0", TOKEN).url(80) == f"http://localhost:80/{TOKEN}/"
    assert Access("::1", TOKEN).url(PORT) == f"http://[::1]:8765/{TOKEN}/"
    assert Access("studio.lab", TOKEN).url(PORT) == f"http://studio.lab:8765/{TOKEN}/"


def test_tokens_are_new_each_time_and_those_given_are_long_enough():
    assert len({Access().token for _ in range(10)}) == 10 and all(len(Access().token) == 24 for _ in range(10))
    for token in ("", "short", "x" * 15, "x" * 129, "with/slash/123456", "with space 123456", "ümlaut-1234567890"):
        with pytest.raises(ExportError, match="token of") as error:
            Access(token=token)
        assert token == "" or token not in str(error.value)


def opened(access, path):
    return access.check(path, Headers(Host=f"localhost:{PORT}"), "127.0.0.1", PORT)


def test_a_one_time_address_has_no_token_and_leads_to_the_page_once(local):
    address = local.opening(PORT)
    path = address.removeprefix(f"http://localhost:{PORT}")
    assert TOKEN not in address and opened(local, f"{path[:-1]}x/").status == 403
    found = opened(local, path)
    assert found.status == 200 and found.headers == {"Refresh": f"0; url=/{TOKEN}/"}
    assert opened(local, path).status == opened(local, "//").status == opened(local, "/").status == 403
    assert opened(local, f"/{TOKEN}/") == Admission("/", True)  # which is open as before


def test_a_one_time_address_is_for_its_own_user_own_hosts_and_no_other_page(local, monkeypatch):
    path = local.opening(PORT).removeprefix(f"http://localhost:{PORT}")
    assert ask(local, path, origin="https://evil.example") == 403 and ask(local, path, host="evil.example") == 421
    monkeypatch.setattr("kinefit.studio.serving.access.is_of_this_user", lambda peer_port, port: False)
    assert opened(local, path).status == 403
    monkeypatch.undo()
    assert opened(local, path).then == f"/{TOKEN}/"
