"""Results of the commands that several images show; kept in the system's folder for temporary files, made once."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray
from PIL import Image

from kinefit.cli import main

IMAGES = Path(__file__).parents[1] / "images"
_KEPT = Path(tempfile.gettempdir()) / "kinefit-drawn"


def data(name: str) -> Path:
    """A folder of real recordings, below $KINEFIT_DATA."""
    return Path(os.environ["KINEFIT_DATA"]) / name


def command(*words: object) -> None:
    """Run `kinefit` with these words; end with what it said where it fails."""
    done = CliRunner().invoke(main, [str(word) for word in words])
    if done.exit_code:
        raise SystemExit(f"{done.output}\n{done.exception!r}")


def folder(name: str) -> Path:
    """An empty or kept folder for results."""
    path = _KEPT / name
    path.mkdir(parents=True, exist_ok=True)
    return path


def demo() -> Path:
    """The results of `kinefit demo`, its take in `take`."""
    out = folder("demo")
    if not (out / "report.html").is_file():
        command("demo", "--out", out)
    return out


def synthetic_demo() -> Path:
    """The results of `kinefit demo --synthetic`."""
    out = folder("synthetic")
    if not (out / "report.html").is_file():
        command("demo", "--synthetic", "--out", out)
    return out


def two_people() -> Path:
    """A copy of the recording of two people, by links."""
    out = folder("two_people")
    for path in data("video_two_people_4cam").iterdir():
        if not (out / path.name).exists():
            (out / path.name).symlink_to(path)
    return out


def reduced(image: NDArray, *, width: int | None = None, height: int | None = None) -> NDArray:
    """An image at another width or height [px]."""
    scale = width / image.shape[1] if width else (height or image.shape[0]) / image.shape[0]
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def save(name: str, image: NDArray, *, palette: bool = True) -> None:
    """Write a BGR image: JPEG of quality 85, or PNG, with a palette of 256 colours if it has no shades."""
    rgb = Image.fromarray(np.ascontiguousarray(image[..., ::-1]))
    if name.endswith(".png"):
        (rgb.quantize(256, dither=Image.Dither.NONE) if palette else rgb).save(IMAGES / name, optimize=True)
    else:
        rgb.save(IMAGES / name, quality=85, optimize=True)
    print(f"{IMAGES / name}: {image.shape[1]} by {image.shape[0]} px, {(IMAGES / name).stat().st_size // 1000} kB")
