"""Files made to exhaust a reader: seconds and memory until its answer, each in a process of its own."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.bags import Bag
from benchmarks.figures import amount, figure
from benchmarks.fuzz import FAULTS, WHOLE, fuzz
from benchmarks.fuzz_seeds_folders import FOLDERS, packed_glb
from kinefit.bodies import load_body
from kinefit.bodies.serial import body_to_arrays

_READ = """
import sys
from pathlib import Path
from benchmarks.fuzz_worker import Seed, answer
from kinefit.bodies import load_body
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.landmarks.detections import read_detections
from kinefit.readers.skeletons.characters import read_character
from kinefit.sensors.kinds.silhouettes import read_silhouettes
from kinefit.readers.videos.video import Video
path = Path(sys.argv[1])
print(*answer(Seed((path,), lambda: {code}), path.parent))
"""


def run() -> None:
    """Print the largest of each figure over all files, then what the fuzzing of the newest seeds finds."""
    answers = []
    for name, (code, make) in FILES.items():
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / name).write_bytes(make())
            kind, seconds, megabytes = _answer(code, Path(folder) / name)
        print(f"# {name}: {kind}, {seconds:.2f} s, {megabytes:.0f} MB", flush=True)
        answers.append((seconds, megabytes, kind != ("read" if name.endswith(("yml", "xml")) else "typed")))
    seconds, megabytes, untyped = zip(*answers)
    figure("faults_readers_bombs_seconds", max(seconds), "s", "<= 2")
    figure("faults_readers_bombs_memory", max(megabytes), "MB", "<= 500")
    figure("faults_readers_bombs_untyped", sum(untyped), "files", "== 0")
    found = [fuzz(name, amount(WHOLE, 10)) for name in list(FOLDERS)[: amount(None, 1)]]
    figure("faults_readers_fuzz", sum(one[kind] for one in found for kind in FAULTS), "files", "== 0")


def _answer(code: str, path: Path) -> tuple[str, float, float]:
    """How a reader answered, its time of the processor [s], its memory [MB] beyond the imports'."""
    try:
        words = [sys.executable, "-c", _READ.format(code=code), str(path)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "stopped", 120.0, 0.0
    kind, seconds, megabytes = done.stdout.split()[:3] if done.returncode == 0 else ("crash", "0", "0")
    return kind, float(seconds), float(megabytes)


def _png(side: int, depth: int = 8) -> bytes:
    """A black grey image, which packs a thousandfold."""
    row, pack = bytes(1 + side * depth // 8), zlib.compressobj(9, wbits=-15)
    packed = pack.compress(row) + pack.flush(zlib.Z_FULL_FLUSH)  # from which on nothing refers to what was before
    adler = struct.pack(">HH", side * len(row) % 65521, 1)  # of zeros
    pixels = b"\x78\xda" + side * packed + b"\x03\x00" + adler
    parts = (b"IHDR", struct.pack(">IIBBBBB", side, side, depth, 0, 0, 0, 0)), (b"IDAT", pixels), (b"IEND", b"")
    chunks = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def _jpeg(side: int) -> bytes:
    """A small JPEG whose header claims another size."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    struct.pack_into(">HH", data, data.find(b"\xff\xc0") + 5, side, side)
    return bytes(data)


def _npz(**arrays: object) -> bytes:
    np.savez(out := io.BytesIO(), **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def _recording() -> bytes:
    """Images of ROS 2 that were all taken at one time."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Bag().images("/a/image_raw", "rgb8", np.zeros((3, 8, 8, 3), np.uint8), step=0)
        bag.messages = [(topic, message, 0) for topic, message, _ in bag.messages]
        return bag.write(Path(folder) / "bag").read_bytes()


_NUMBERS = [f"{k}.5" for k in range(50_000)]
_CAMERA = "cam:\n   K: [ [ 50., 0., 32. ], [ 0., 50., 24. ], [ 0., 0., 1. ] ]\n   size: [ 64, 48 ]\n"
_YAML = f"%YAML:1.0\n---\n{_CAMERA}x: [ {', '.join(_NUMBERS)} ]\n"
_MATRIX = "<rows>3</rows><cols>3</cols><dt>d</dt><data>50. 0. 32. 0. 50. 24. 0. 0. 1.</data>"
_XML = f'<cam><K type_id="opencv-matrix">{_MATRIX}</K><size>64 48</size></cam><x>{" ".join(_NUMBERS)}</x>'
_XML = f'<?xml version="1.0"?>\n<opencv_storage>{_XML}</opencv_storage>'
_CHAIN = {"asset": {"version": "2.0"}, "nodes": [{"children": [k + 1]} for k in range(100_000)] + [{}]}
_NOBODY = {"format": "kinefit detections", "version": 1, "key": "", "camera": "a", "rate": 30.0, "size": (8, 6),
           "points": np.zeros((1, 1, 33, 2)), "confidence": np.zeros((1, 1, 33)), "mask_starts": [0, 48]}  # fmt: skip
_VIDEO, _DEPTH = "Video(path.parent, rate=30.0).read(0)", "read_depth(path, rate=30.0).frame(0)"

FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "0.png": (_VIDEO, lambda: _png(30_000)), "0.jpg": (_VIDEO, lambda: _jpeg(17_000)),
    "mask.png": ("read_silhouettes(path, camera='a', rate=30.0, size=(64, 48)).frame(0)", lambda: _png(30_000)),
    "depth.png": (_DEPTH, lambda: _png(30_000, 16)),
    "blank.yml": ("read_calibration(path)", lambda: ("# by hand\n" + 20_000 * "\n" + _CAMERA).encode()),
    "numbers.yml": ("read_calibration(path)", _YAML.encode),
    "numbers.xml": ("read_calibration(path)", _XML.encode),
    "chain.glb": ("read_character(path)", lambda: packed_glb(_CHAIN, b"")),
    "times.npz": (_DEPTH, lambda: _npz(depth=np.ones((2, 8, 8)), times=np.array(["a", "b"]))),
    "runs.npz": ("read_detections(path).mask(0, 0)", lambda: _npz(**_NOBODY, mask_runs=np.ones((48, 1)))),
    "body.npz": ("load_body(path)", lambda: _npz(**body_to_arrays(load_body("arm")) | {"usual": np.full(7, np.nan)})),
    "once.mcap": ("Video(path / 'a/image_raw').read(0)", _recording),
}  # fmt: skip
"""{file: (what reads it, its content)}; all but YAML and XML are to be refused."""
