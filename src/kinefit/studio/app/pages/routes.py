"""The addresses of the app: its pages, images and files."""

from __future__ import annotations

from collections.abc import Callable
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

    @ui.page("/")
    async def home() -> None:
        await home_page(desk)

    @ui.page("/take")
    async def take(path: str) -> None:
        await take_page(desk, path)

    @ui.page("/result")
    async def result(path: str, folder: str) -> None:
        await result_page(desk, Path(path), Path(folder))

    @ui.page("/session")
    async def session() -> None:
        await session_page(desk)

    @ui.page("/compare")
    async def compare(a: str, b: str) -> None:
        await compare_page(desk, Path(a), Path(b))

    @ui.page("/live")
    async def live() -> None:
        await live_page(desk)

    def of_video(read: Callable[[], NDArray[np.uint8]]) -> Response:
        """What `read` gives, unrecognisable where faces are hidden."""
        if desk.hide_faces is None:
            return Response(status_code=403)
        try:
            image = read()
        except KinefitError as error:
            return Response(str(error), status_code=404)
        return _image(jpeg(unrecognisable(image) if desk.hide_faces else image, _THUMBNAIL_PX))

    @app.get("/image/first")
    def first(path: str) -> Response:
        return of_video(lambda: first_image(Path(path)))

    @app.get("/image/raw")
    def raw(path: str, share: float, start: float = 0.0, stop: float | None = None) -> Response:
        return of_video(lambda: image_at(Path(path), share, start=start, stop=stop))

    @app.get("/image/person")
    def person(path: str, number: int) -> Response:
        if desk.hide_faces is None:
            return Response(status_code=403)
        image = desk.people.known(Path(path), number, hide_faces=desk.hide_faces)
        return Response(status_code=404) if image is None else _image(jpeg(image, _THUMBNAIL_PX))

    @app.get("/image/frame")
    def frame(folder: str, camera: str, frame: int, longest: int = 640) -> Response:
        review = desk.opened(Path(folder))
        if desk.hide_faces is None or review is None:
            return Response(status_code=403)
        try:
            return _image(jpeg(review.image(camera, frame), longest))
        except KinefitError as error:
            return Response(str(error), status_code=404)

    @app.get("/file")
    def file(path: str) -> Response:
        if desk.hide_faces is None:
            return Response(status_code=403)
        address = desk.files.address(Path(path))
        return Response(status_code=404) if address is None else RedirectResponse(address, status_code=303)


def _image(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"Cache-Control": "no-store"})
