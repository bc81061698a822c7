"""A 3D scene that a page shows, served at an address of its own."""

from __future__ import annotations

import threading

from kinefit.serving.access import Access
from kinefit.viewers.player import Player
from kinefit.viewers.show import ViewerContent
from kinefit.viewers.stage import open_server, quiet

_END_TIMEOUT_S = 5.0  # of the frame that is shown


class ScenePage:
    """A player of motions that runs until it is closed.

    Parameters
    ----------
    content : ViewerContent
    with_panel : whether the player's controls are open at first

    Attributes
    ----------
    address : of its page, with the token
    player : Player

    Raises
    ------
    ExportError
        No port is free.
    """

    def __init__(self, content: ViewerContent, *, with_panel: bool = True) -> None:
        access = Access()
        self._server = open_server(0, access, label=content.name)
        self.address = access.url(self._server.get_port())
        self.player = Player(self._server, content)
        if not with_panel:
            self._server.gui.main_panel.minimize()
        self._ended = threading.Event()
        self._running = threading.Thread(target=self.player.run, args=(self._ended.is_set,), daemon=True)
        self._running.start()

    def close(self) -> None:
        """End the player and its server."""
        self._ended.set()
        self._running.join(_END_TIMEOUT_S)
        with quiet():
            self._server.stop()
