"""Damage to files, the same for the same seed: cut, flipped, spliced, numbers made extreme, members of archives."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib

import numpy as np

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORDS = (
    b"0", b"-1", b"1", b"65536", b"2147483647", b"-2147483648", b"4294967296", b"9223372036854775808", b"1e11", b"1e20",
    b"1e308", b"-1e308", b"1e-320", b"0.5", b"1.0", b"100000", b"-0.0", b"1e999",
    b"nan", b"inf", b"-inf", b"NaN", b"Infinity", b"0x7f", b"1,5", b"", b"-", b'"text"', b"null", b"true", b"[]", b"{}",
    b"9" * 400, b"9" * 5000, b"\xff\xfe", b"\0",
)  # fmt: skip
_PLAIN = 18  # of these are numbers in every format, so that what follows them is read
_INTEGERS = (0, 1, *(2**n - 1 for n in (7, 8, 15, 16, 31, 32, 64)), *(2**n for n in (7, 15, 31, 40, 63)))
_FLOATS = (0.0, -0.0, 1e-40, 1e30, -1e30, float("inf"), float("-inf"), float("nan"), 1e300)


def mutated(data: bytes, seed: list[int]) -> bytes:
    """The bytes of a file, damaged in one to three ways."""
    rng = np.random.default_rng(seed)
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        data = _inside(data, rng) if rng.random() < 0.7 else _once(data, rng)
    return data


def _inside(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage within what the bytes pack, where they pack something; else to the bytes."""
    if data[:2] == b"PK":
        try:
            return _member(data, rng)
        except Exception:
            return _once(data, rng)
    if data[:2] == b"\x1f\x8b":
        try:
            return gzip.compress(_once(gzip.decompress(data), rng), 1, mtime=0)
        except Exception:
            return _once(data, rng)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _chunk(data, rng)
    if data[:4] == b"glTF" and rng.random() < 0.6:
        try:
            return _glb(data, rng)
        except Exception:
            return _once(data, rng)
    if data[:1] in (b"{", b"[") and rng.random() < 0.6:
        try:
            return _leaf(data, rng)
        except Exception:  # no JSON: a TOML file, or one that is damaged already
            return _entry(data, rng)
    if _TABLE.search(data) and rng.random() < 0.6:
        return _entry(data, rng)
    return _once(data, rng)


_TABLE = re.compile(rb"(?m)^\[\[?[\w.]+\]\]?[ \t]*$")
_LINE = re.compile(rb"(?m)^[ \t]*[\w.\"]+[ \t]*=[ \t]*(.*)$")
_VALUES = (
    "0", "-1", "1", "2", "0.5", "-0.0", "1e-320", "1e-9", "1e9", "1e308", "-1e308", "9223372036854775807", "nan",
    "inf", "-inf", "true", '""', '"text"', '"1"', '"."', '"/"', '"../.."', '"*"', '"a**"', '"[\\u0000"',
    '"\u00e4\u4eba"', '"m"', '"x"', '"%s"' % ("a" * 5000), '"%s"' % ("a/" * 3000), "[]", "[[]]", "[0]", "[0, 0]",
    "[1, 0]", "[0, 0, 0]", "[0, 0, 0, 0]", "[1e308, 1e308, 1e308]", "[1, 1, 1e-300]", '["a", "a"]', "{}",
    f"[{', '.join(['1'] * 3000)}]", "[[1, 2], [3]]",
)  # fmt: skip
"""Values that TOML has, and JSON but for a few: what follows them is read."""


def _entry(data: bytes, rng: np.random.Generator) -> bytes:
    """A TOML file that still is one: a value replaced, by another line's too, or a line left out or twice."""
    lines = list(_LINE.finditer(data[:200_000]))
    if not lines:
        return _once(data, rng)
    line, way = lines[int(rng.integers(len(lines)))], rng.random()
    if way < 0.1:
        return data[: line.start()] + data[line.end() :]
    if way < 0.2:  # a table of its own, such as a sensor, twice
        starts = [found.start() for found in _TABLE.finditer(data)] + [len(data)]
        k = int(rng.integers(len(starts) - 1)) if len(starts) > 1 else 0
        return data + b"\n" + data[starts[k] : starts[min(k + 1, len(starts) - 1)]]
    numbers = list(_NUMBER.finditer(line[1]))
    if way < 0.5 and numbers:
        place = numbers[int(rng.integers(len(numbers)))]
        new = line[1][: place.start()] + _VALUES[int(rng.integers(15))].encode() + line[1][place.end() :]
    elif way < 0.7:
        new = lines[int(rng.integers(len(lines)))][1]
    else:
        new = _VALUES[int(rng.integers(len(_VALUES)))].encode()
    return data[: line.start(1)] + new + data[line.end(1) :]


def _leaf(data: bytes, rng: np.random.Generator) -> bytes:
    """A JSON file that still is one: something in it replaced, by another part too, or left out."""
    tree = json.loads(data)
    places: list[tuple] = []
    rooms = [tree]
    while rooms:
        room = rooms.pop()
        for key in room if isinstance(room, dict) else range(len(room)):
            places.append((room, key))
            if isinstance(room[key], dict | list):
                rooms.append(room[key])
    (room, key), way = places[int(rng.integers(len(places)))], rng.random()
    if way < 0.15:
        del room[key]
    elif way < 0.35:
        other, name = places[int(rng.integers(len(places)))]
        room[key] = json.loads(json.dumps(other[name]))
    else:
        text = ("null", "1e400", "[null, null]", *_VALUES)[int(rng.integers(len(_VALUES) + 3))]
        room[key] = {"nan": float("nan"), "inf": float("inf"), "-inf": -float("inf")}.get(text) or json.loads(text)
    return json.dumps(tree).encode()


def _glb(data: bytes, rng: np.random.Generator) -> bytes:
    """A GLB file with something in its JSON replaced, and its lengths made right again."""
    length = struct.unpack_from("<I", data, 12)[0]
    text = _leaf(data[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + b"JSON" + text + data[20 + length :]
    return data[:8] + struct.pack("<I", 12 + len(body)) + body


def _member(data: bytes, rng: np.random.Generator) -> bytes:
    """An archive with one member damaged, left out, of another name, or much larger than its packed bytes."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    chosen, way = int(rng.integers(len(members))), rng.random()
    name, content = members[chosen]
    if way < 0.05:
        del members[chosen]
    elif way < 0.1:
        members[chosen] = f"{name}x", content
    elif way < 0.15:
        members[chosen] = name, content + bytes(int(rng.choice([10_000, 20_000_000])))
    elif way < 0.2:
        members[chosen] = name, members[int(rng.integers(len(members)))][1]
    elif content[:6] == b"\x93NUMPY" and way < 0.6:  # what its header says, padded so that it is read
        end = 10 + struct.unpack("<H", content[8:10])[0]
        head = _once(content[10:end].strip(), rng)[:60_000]
        head += b" " * (-(len(head) + 11) % 64) + b"\n"
        members[chosen] = name, content[:8] + struct.pack("<H", len(head)) + head + content[end:]
    else:
        members[chosen] = name, _once(content, rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0)), content)
    return out.getvalue()


def _chunk(data: bytes, rng: np.random.Generator) -> bytes:
    """A PNG image with one chunk damaged and its sum made right again."""
    parts, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack(">I", data[at : at + 4])[0]
        parts.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + size]])
        at += 12 + size
    if not parts:
        return _once(data, rng)
    part = parts[int(rng.integers(len(parts)))]
    part[1] = _once(part[1], rng)
    chunks = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in parts)
    return data[:8] + b"".join(chunks)


_WAYS = "cut", "flip", "copy", "leave", "bytes", "number", "word", "lines", "deep", "many"


def _once(data: bytes, rng: np.random.Generator) -> bytes:
    """One kind of damage."""
    if not data:
        return bytes(rng.integers(0, 256, 8, dtype=np.uint8))
    a, b, c = sorted(int(v) for v in rng.integers(0, len(data) + 1, 3))
    way = rng.choice([*_WAYS, "number", "number"])
    if way == "cut":
        return data[:a]
    if way == "flip":
        out = bytearray(data)
        for place in rng.integers(0, len(data), int(rng.choice([1, 2, 8, 64]))):
            out[place] ^= 1 << int(rng.integers(8))
        return bytes(out)
    if way == "copy":
        return data[:a] + data[b : min(c, b + 4096)] * int(rng.choice([1, 1, 2, 50])) + data[a:]
    if way == "leave":
        return data[:a] + data[min(b, a + 256) :]
    if way == "bytes":
        return data[:a] + bytes(rng.integers(0, 256, int(rng.integers(1, 64)), dtype=np.uint8)) + data[a:]
    if way == "word":
        return data[:a] + _pack(rng) + data[a + 4 :]
    if way == "deep":
        sign = rng.choice([b"[", b"{", b"(", b"<a>", b'{"a":', b"a.", b"- "])
        return data[:a] + bytes(sign) * int(rng.choice([3, 5000, 50_000])) + data[a:]
    if way == "many":  # for which a reader whose time grows by the square of the length takes long
        line = data[data.rfind(b"\n", 0, a) + 1 : a + 2000].split(b"\n")[0]
        unit = (b"\n", b" ", line + b"\n", line[-12:] + b" ")[int(rng.integers(4))]
        return data[:a] + unit * min(50_000, 400_000 // len(unit)) + data[a:]
    if way == "lines":
        lines = data.split(b"\n")
        i, j = (int(v) for v in rng.integers(0, len(lines), 2))
        lines[i] = lines[j] if rng.random() < 0.5 else lines[i] + lines[j]
        return b"\n".join(lines)
    found = list(_NUMBER.finditer(data[:200_000]))
    if not found:
        return data[:a] + _pack(rng) + data[a + 4 :]
    place = found[int(rng.integers(len(found)))]
    word = _WORDS[int(rng.integers(_PLAIN if rng.random() < 0.6 else len(_WORDS)))]
    return data[: place.start()] + word + data[place.end() :]


def _pack(rng: np.random.Generator) -> bytes:
    """An extreme number in bytes."""
    order = "<" if rng.random() < 0.7 else ">"
    if rng.random() < 0.5:
        value, kind = _FLOATS[int(rng.integers(len(_FLOATS)))], f"{order}f{rng.choice([4, 8])}"
        with np.errstate(over="ignore"):
            return np.array(value).astype(kind).tobytes()
    size = int(rng.choice([1, 2, 4, 8]))
    value = _INTEGERS[int(rng.integers(len(_INTEGERS)))] % 256**size
    return value.to_bytes(size, "little" if order == "<" else "big")
