"""Whose connection it is."""

import os
import socket
import sys
from pathlib import Path

import pytest

from kinefit.studio.serving.access import is_of_this_user


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says whose a connection is")
def test_a_connection_of_this_user_and_of_another(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client:
            peer = client.getsockname()[1]
            assert is_of_this_user(peer, port) and is_of_this_user(0, port)
            monkeypatch.setattr("os.getuid", lambda: -1)
            assert not is_of_this_user(peer, port) and is_of_this_user(0, port)


def test_where_the_system_does_not_say_everybody_may(monkeypatch):
    def refuse(path):
        raise FileNotFoundError(path)

    monkeypatch.setattr(Path, "read_text", refuse)
    assert is_of_this_user(40_000, 8090) and os.name
