"""Whose process is at the other end of a connection within this computer."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def is_of_this_user(peer_port: int, port: int) -> bool:
    """Whether a connection between two ports of this computer was opened by this user.

    Only Linux says who opened it. Where it is not known, the answer is yes.
    """
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                _, local, remote, _, _, _, _, user, *_ = line.split()
                if [int(end.rpartition(":")[2], 16) for end in (local, remote)] == [peer_port, port]:
                    return int(user) == os.getuid()
    return True
