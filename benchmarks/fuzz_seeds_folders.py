"""Seeds of characters (GLB, VRM, glTF), of manual annotations, of TIFF, and of whole folders of takes."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.fuzz_seeds import FIRST, Seed, depth_counts, finite
from benchmarks.fuzz_seeds_takes import LATER

_VRM = {"hips": "Hips", "head": "Head", "leftUpperArm": "LeftArm", "rightUpperLeg": "RightUpLeg"}


def _character(ending: str) -> Callable[[Path], Seed]:
    """A figure as kinefit writes it; as VRM with names of its own; as glTF with its buffer and an image beside it."""

    def make(folder: Path) -> Seed:
        from kinefit.exporters import write_character, write_glb
        from kinefit.readers.skeletons.characters import read_character
        from kinefit.simulation import cut, squat_and_wave

        motion, path = cut(squat_and_wave(), 0, 2), folder / f"a{ending}"
        write_glb(motion, folder / "a.glb", names="mixamo")
        content = (folder / "a.glb").read_bytes()
        length = struct.unpack_from("<I", content, 12)[0]
        tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
        files = [path]
        if ending == ".vrm":
            places = {node["name"].split(":")[-1]: number for number, node in enumerate(tree["nodes"])}
            bones = {bone: {"node": places[name]} for bone, name in _VRM.items()}
            tree["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}
            path.write_bytes(packed_glb(tree, binary))
        elif ending == ".gltf":
            tree["buffers"][0]["uri"], tree["images"] = "a.bin", [{"uri": "a.png"}]
            (folder / "a.bin").write_bytes(binary)
            cv2.imwrite(str(folder / "a.png"), np.zeros((4, 4, 3), np.uint8))
            path.write_text(json.dumps(tree))
            files += [folder / "a.bin", folder / "a.png"]

        def read() -> object:
            character = read_character(path)
            finite([character.positions, character.rotations, character.scales, character.points])
            return write_character(motion, path, folder / "out.glb")

        return Seed(tuple(files), read)

    return make


def packed_glb(tree: dict, binary: bytes) -> bytes:
    """A GLB file of a JSON tree and its buffer."""
    text = json.dumps(tree).encode()
    text, binary = text + b" " * (-len(text) % 4), binary + bytes(-len(binary) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _clicks(folder: Path) -> Seed:
    from kinefit.readers.landmarks.annotations import clicks_text, read_clicks

    points = {camera: {name: [812.0, 401.5] for name in ("r_knee", "l_knee", "c7")} for camera in ("a", "b")}
    (folder / "clicks.json").write_text(json.dumps({"step": 0, "points": points}))

    def read() -> object:
        steps = read_clicks(folder / "clicks.json")
        places = [finite(of.places(camera)) for of in steps for camera in of.points if of.names]
        return clicks_text(steps), places

    return Seed((folder / "clicks.json",), read)


def _pages(folder: Path) -> Seed:
    from kinefit.readers.depth.recordings import read_depth

    cv2.imwritemulti(str(folder / "a.tiff"), list(depth_counts()))

    def read() -> object:
        video = read_depth(folder / "a.tiff", rate=30.0)
        return [video.frame(i) for i in range(min(len(video), 3))]

    return Seed((folder / "a.tiff",), read)


def _masks(folder: Path) -> Seed:
    from kinefit.sensors.kinds.silhouettes import read_silhouettes

    packings = (
        cv2.IMWRITE_TIFF_COMPRESSION_LZW, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE, cv2.IMWRITE_TIFF_COMPRESSION_NONE,
    )  # fmt: skip
    shapes = (48, 64), (48, 64, 3), (48, 64, 4)
    (folder / "masks").mkdir()
    for i, (shape, packing) in enumerate(zip(shapes, packings)):
        mask = np.zeros(shape, np.uint8 if i else np.uint16)
        mask[10:30] = 255
        cv2.imwrite(str(folder / "masks" / f"{i}.tif"), mask, [cv2.IMWRITE_TIFF_COMPRESSION, packing])

    def read() -> object:
        video = read_silhouettes(folder / "masks", camera="a", rate=30.0, size=(64, 48))
        return [video.frame(i) for i in range(len(video))]

    return Seed(tuple(sorted((folder / "masks").iterdir())), read)


def _folder_of(take: Callable[[Path], Seed]) -> Callable[[Path], Seed]:
    """All files of a take are damaged, one at a time, and every recording of it is read."""

    def make(folder: Path) -> Seed:
        from kinefit.readers.take.file import read_take
        from kinefit.readers.take.load import load_observations
        from kinefit.readers.take.videos import load_stereo

        take(folder)

        def read() -> object:
            found = read_take(folder / "take.toml")
            seen = load_observations(found)
            return [video.frame(i) for video in (*seen.recordings, *load_stereo(found, seen))
                    for i in range(min(len(video), 3))]  # fmt: skip

        return Seed(tuple(sorted(file for file in folder.rglob("*") if file.is_file())), read)

    return make


FOLDERS: dict[str, Callable[[Path], Seed]] = {
    "character glb": _character(".glb"), "character vrm": _character(".vrm"), "character gltf": _character(".gltf"),
    "clicks": _clicks, "depth pages": _pages, "masks tiff": _masks, "take folder": _folder_of(FIRST["take"]),
    "take folder of all sensors": _folder_of(LATER["take of all sensors"]),
    "take folder of depth": _folder_of(LATER["take of depth"]),
}  # fmt: skip
"""{reader: maker of its seed}."""
