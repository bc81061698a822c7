"""Read glTF 2.0 files: the JSON, one binary buffer, and its arrays."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes
from kinefit.errors import FileError, names_file
from kinefit.geometry import se3

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_IMAGES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
MALFORMED = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError, OSError, struct.error,
)  # fmt: skip
"""Exceptions that a malformed glTF file raises while it is read."""

_LIST_KEYS = "nodes", "skins", "meshes", "animations", "accessors", "bufferViews", "buffers", "images"
_EXPORT_REMEDY = "Export the character again, as GLB."


@dataclass(frozen=True, eq=False)
class Gltf:
    """A glTF file.

    Parameters
    ----------
    json : dict of the file, with one buffer without URI and embedded images.
    binary : bytes of that buffer.
    """

    json: dict[str, Any]
    binary: bytes

    def array(self, number: int) -> NDArray | None:
        """(N, width) values of an accessor, normalised ones as fractions; None for a compressed or sparse one.

        Raises ValueError for overlapping elements.
        """
        accessor = self.json["accessors"][number]
        if "bufferView" not in accessor or "sparse" in accessor:
            return None
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        step = view.get("byteStride", kind.itemsize * width)
        if step < kind.itemsize * width:  # overlapping elements could be any number
            raise ValueError(f"byteStride {step}")
        shape, strides = (accessor["count"], width), (step, kind.itemsize)
        out = np.ndarray(shape, kind, self.binary, start, strides).astype(float)
        return out / np.iinfo(kind).max if accessor.get("normalized") and kind.kind in "iu" else out

    def parents(self) -> NDArray:
        """(N,) int, parent of every node, -1 for none."""
        out = np.full(len(self.json.get("nodes", [])), -1)
        for number, node in enumerate(self.json.get("nodes", [])):
            out[node.get("children", [])] = number
        return out

    def local(self, node: int) -> NDArray:
        """(4, 4) pose of a node in its parent, with its scale."""
        entry = self.json["nodes"][node]
        if "matrix" in entry:
            return np.reshape(np.array(entry["matrix"], float), (4, 4)).T
        x, y, z, w = entry.get("rotation", (0, 0, 0, 1))
        R = se3.rotation_from_quaternion(np.array([w, x, y, z], float))
        return se3.transform(R * np.array(entry.get("scale", (1, 1, 1)), float), entry.get("translation", (0, 0, 0)))


@names_file
def read_gltf(path: str | PathLike[str]) -> Gltf:
    """Read a GLB (also VRM) or glTF file; external buffers and images are embedded.

    Raises
    ------
    FileError
        Missing, truncated, not glTF 2.0, or an external file that is missing or outside of its folder.
    """
    path = Path(path)
    content = read_bytes(path)
    try:
        tree, binary = _chunks(content) if content[:4] == b"glTF" else (json.loads(content), b"")
        if not str(tree["asset"]["version"]).startswith("2."):
            raise FileError(f"is glTF {tree['asset']['version']}, not 2.0", remedy=_EXPORT_REMEDY)
        if wrong := [name for name in _LIST_KEYS if not isinstance(tree.get(name, []), list)]:
            raise ValueError(f"{wrong[0]} is no list")
        return _in_one(tree, binary, path)
    except MALFORMED as error:
        problem = f"is no whole glTF file ({type(error).__name__}: {error})"
        raise FileError(problem, remedy=_EXPORT_REMEDY) from error


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a GLB."""
    _, version, total, length, kind = struct.unpack("<4sIII4s", content[:20])
    if version != 2 or total > len(content) or kind != b"JSON":
        raise ValueError("version, length or first chunk")
    tree, rest = json.loads(content[20 : 20 + length]), content[20 + length : total]
    size, kind = struct.unpack("<I4s", rest[:8]) if len(rest) >= 8 else (0, b"BIN\0")
    if kind != b"BIN\0" or len(rest) < size:
        raise ValueError("binary chunk")
    return tree, rest[8 : 8 + size]


def _in_one(tree: dict[str, Any], binary: bytes, path: Path) -> Gltf:
    """Merge all buffers into one, in order, and embed the images."""
    data, places = bytearray(), dict[str | None, tuple[int, int]]()

    def place(uri: str | None) -> tuple[int, int]:
        """Start and length of the content of a URI, which is embedded once."""
        if uri not in places:
            content = binary if uri is None else _content(uri, path)
            data.extend(bytes(-len(data) % 4))  # every piece begins at a multiple of four
            places[uri] = len(data), len(content)
            data.extend(content)
        return places[uri]

    buffers = tree.get("buffers", [])
    if any("uri" not in buffer for buffer in buffers[1:]):
        raise ValueError("a buffer without a URI that is not the first")
    starts = [place(buffer.get("uri"))[0] for buffer in buffers]
    for view in tree.get("bufferViews", []):
        start = starts[view["buffer"]]
        if start:
            view["byteOffset"] = view.get("byteOffset", 0) + start
        view["buffer"] = 0
        if view.get("byteOffset", 0) + view["byteLength"] > len(data):
            raise ValueError("a buffer is shorter than it should be")
    for image in tree.get("images", []):
        if "uri" in image:
            uri = image.pop("uri")
            named = _IMAGES.get(Path(uri).suffix.lower(), "image/png")
            image.setdefault("mimeType", uri[5:].partition(";")[0] if uri.startswith("data:") else named)
            start, length = place(uri)
            image["bufferView"] = len(tree.setdefault("bufferViews", []))
            tree["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": length})
    tree["buffers"] = [{**(tree.get("buffers") or [{}])[0], "byteLength": len(data)}]
    tree["buffers"][0].pop("uri", None)
    return Gltf(tree, bytes(data))


def _content(uri: str, path: Path) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file, folder = (path.parent / unquote(uri)).resolve(), path.parent.resolve()
    if not file.is_relative_to(folder):  # else a malicious character could embed any file of the user
        problem = f"it names a file outside of its folder: {uri}"
        raise FileError(problem, remedy="Move that file into the folder, or export the character as GLB.")
    return read_bytes(file)
