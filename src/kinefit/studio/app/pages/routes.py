"""The addresses of the app: its pages, images and files."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
from fastapi import Response
from fastapi.responses import RedirectResponse
from nicegui import app, ui
from numpy.typing import NDArray

from kinefit.errors import KinefitError
from kinefit.readers.videos.video_files import first_image, image_at
from kinefit.studio.app.desk import Desk
from kinefit.studio.app.pages.home import compare_page, home_page, session_page
from kinefit.studio.app.pages.live import live_page
from kinefit.studio.app.pages.result import result_page
from kinefit.studio.app.pages.take import take_page
from kinefit.studio.app.people import jpeg, unrecognisable

_THUMBNAIL_PX = 384


def add_pages(desk: Desk) -> None:
    """Register all pages of a desk with NiceGUI's application."""

    async def asked(page: Callable[..., Awaitable[None]], *arguments: object) -> None:
        """A page; before it is chosen whether faces are shown, the first one, which asks for it."""
        if desk.hide_faces is None:
            ui.navigate.to("/")
        else:
            await page(desk, *arguments)

    @ui.page("/")
    async def home() -> None:
        await home_page(desk)

    @ui.page("/take")
    async def take(path: str) -> None:
        await asked(take_page, path)

    @ui.page("/result")
    async def result(path: str, folder: str) -> None:
        await asked(result_page, Path(path), Path(folder))

    @ui.page("/session")
    async def session() -> None:
        await asked(session_page)

    @ui.page("/compare")
    async def compare(a: str, b: str) -> None:
        await asked(compare_page, Path(a), Path(b))

    @ui.page("/live")
    async def live() -> None:
        await asked(live_page)

    def shown(read: Callable[[], NDArray[np.uint8] | None], longest: int = _THUMBNAIL_PX) -> Response:
        """The image that `read` gives."""
        if desk.hide_faces is None:
            return Response(status_code=403)
        try:
            image, problem = read(), ""
        except KinefitError as error:
            image, problem = None, str(error)
        if image is None:
            return Response(problem, status_code=404)
        headers = {"Cache-Control": "no-store"}
        return Response(jpeg(image, longest), media_type="image/jpeg", headers=headers)

    def hidden(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image, unrecognisable where faces are hidden."""
        return unrecognisable(image) if desk.hide_faces else image

    @app.get("/image/first")
    def first(path: str) -> Response:
        return shown(lambda: hidden(first_image(Path(path))))

    @app.get("/image/raw")
    def raw(path: str, share: float, start: float = 0.0, stop: float | None = None) -> Response:
        return shown(lambda: hidden(image_at(Path(path), share, start=start, stop=stop)))

    @app.get("/image/person")
    def person(path: str, number: int) -> Response:
        return shown(lambda: desk.people.known(Path(path), number, hide_faces=bool(desk.hide_faces)))

    @app.get("/image/frame")
    def frame(folder: str, camera: str, frame: int, longest: int = 640) -> Response:
        review = desk.opened(Path(folder))
        return Response(status_code=403) if review is None else shown(lambda: review.image(camera, frame), longest)

    @app.get("/file")
    def file(path: str) -> Response:
        if desk.hide_faces is None:
            return Response(status_code=403)
        address = desk.files.address(Path(path))
        return Response(status_code=404) if address is None else RedirectResponse(address, status_code=303)
