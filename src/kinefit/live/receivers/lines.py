"""Write poses as JSON lines to a file or the standard output."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import BinaryIO

from kinefit.bodies import Body
from kinefit.errors import ExportError
from kinefit.live.packets import PosePacket


class JsonLines:
    """Writes every packet as one line; "-" is the standard output.

    Raises
    ------
    ExportError
        The file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._file: BinaryIO = sys.stdout.buffer if str(path) == "-" else open(self.path, "wb")
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.path, remedy="Give another file with --json.") from error

    def hello(self, body: Body, packet: bytes) -> None:
        """Write the packet of a new body as one line."""
        self._write(packet)

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Write the packet of a pose as one line."""
        self._write(packet)

    def close(self) -> None:
        """Close the file."""
        if self._file is not sys.stdout.buffer:
            self._file.close()

    def _write(self, packet: bytes) -> None:
        try:
            self._file.write(packet + b"\n")
            self._file.flush()
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise ExportError(problem, file=self.path, remedy="Free some space, or give another --json.") from error
