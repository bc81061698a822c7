"""The addresses of the app: its pages, images and files."""

from __future__ import annotations

from pathlib import Path

from fastapi import Response
from fastapi.responses import FileResponse
from nicegui import app, ui

from kinefit.app.desk import Desk
from kinefit.app.images import jpeg, unrecognisable
from kinefit.app.pages.home import home_page
from kinefit.app.pages.result import result_page
from kinefit.app.pages.take import take_page
from kinefit.errors import KinefitError
from kinefit.readers.video_files import first_image

_THUMBNAIL_PX = 384
_PAGES = (".html",)  # files that are shown as pages: reports and check pages
_SANDBOX = {"Content-Security-Policy": "sandbox allow-scripts allow-downloads", "Cache-Control": "no-store"}
"""Pages that lie in folders of recordings run apart from the app, whose addresses they cannot read."""


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

    @app.get("/image/first")
    def first(path: str) -> Response:
        if desk.hide_faces is None:
            return Response(status_code=403)
        try:
            image = first_image(Path(path))
        except KinefitError as error:
            return Response(str(error), status_code=404)
        return _image(jpeg(unrecognisable(image) if desk.hide_faces else image, _THUMBNAIL_PX))

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
        if Path(path).suffix.lower() not in _PAGES or not Path(path).is_file():
            return Response(status_code=404)
        return FileResponse(path, headers=_SANDBOX)


def _image(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"Cache-Control": "no-store"})
