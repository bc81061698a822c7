"""Assign files to cameras: by names, numbers, image sizes, and by order as the last resort."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from kinefit.readers.depth.images import natural

# Words before the number of a camera: "Camera 1", "port_0", "GoPro3", "c2". Longer words first.
_CAMERA_WORD = r"(?:camera|cam|kamera|port|view|gopro|kinect|miqus|webcam|device|dev|c|v|k)"
_NUMBERED = re.compile(rf"(?<![a-z]){_CAMERA_WORD}[\s_.#-]*(\d+)", re.IGNORECASE)

HOW = {
    "name": ("sure", "by its name"),
    "number": ("likely", "by the number in its name"),
    "shifted": ("guess", "by the number in its name, which counts from another start"),
    "size": ("likely", "by its image size"),
    "nth": ("likely", "by its folder, whose files are recordings in their order"),
    "uneven": ("guess", "by its folder; files are taken as recordings in their order, of different numbers"),
    "order": ("guess", "by order only: its name contains no camera"),
}
"""{way of matching: (confidence level, its text in a message)}, in order of decreasing confidence."""


@dataclass(frozen=True)
class Trial:
    """Files of one kind that were recorded together, one for each camera.

    Parameters
    ----------
    files : {camera: Path}
        In the order of the calibration.
    how : str
        The way of `HOW` with the least confidence among the files.
    place : str
        Path within the folder, "*" in place of the cameras' names: "walk/videos/*".
    """

    files: Mapping[str, Path]
    how: str
    place: str


def common_words(place: str, other: str) -> int:
    """Number of words that two places share: files of one recording mostly have some in common."""
    words = [set(re.findall(r"[a-z0-9]+", text.lower())) for text in (place, other)]
    return len(words[0] & words[1])


COUNTED = re.compile(
    r"(?:img|imgp|dsc[fn]?|mvi|vid|gopr|gp|g[hxl]|dji|pxl|mov|mah|clip|sam|c|p)?[_-]?\d{4}[\d_-]*", re.IGNORECASE
)
"""Stems of files that a camera counts by itself: they say nothing of which recording is whose."""

_CHAPTER = re.compile(r"(?:G[HXLP](?P<chapter>\d\d)|GOPR)(?P<number>\d{4})", re.IGNORECASE)


def later_chapters(videos: Sequence[Path]) -> dict[Path, Path]:
    """{video: first chapter of its recording} of the videos that a GoPro began when a file was full."""
    chapters: dict[tuple[Path, str], list[tuple[str, Path]]] = defaultdict(list)
    for path in videos:
        if found := _CHAPTER.fullmatch(path.stem):
            chapters[path.parent, found["number"]].append((found["chapter"] or "", path))
    return {path: min(group)[1] for group in chapters.values() for _, path in sorted(group)[1:]}


def trials(
    paths: Sequence[Path], folder: Path, names: Sequence[str], sizes: Mapping[Path, object] | None = None,
    wanted: Mapping[str, object] | None = None,
) -> tuple[list[Trial], list[Path]]:
    """Group files into recordings, and assign them to cameras within each.

    Parameters
    ----------
    paths : files or folders, each of one camera
    folder : that contains all of them
    names : of the calibration's cameras
    sizes : {path: (width, height) [px] of its image}, optional
    wanted : {camera: (width, height) [px] of the calibration's image}, optional

    Returns
    -------
    trials, the one with most cameras first; files that fit no camera.
    """
    groups: dict[str, dict[str, Path]] = defaultdict(dict)
    ways: dict[str, str] = {}
    left: list[Path] = []
    for path in sorted(paths, key=lambda p: natural(str(p))):
        found = camera_of(path, folder, names)
        if found is None or found[0] in groups[found[2]]:
            left.append(path)
            continue
        camera, how, place = found
        groups[place][camera] = path
        ways[place] = max(how, ways.get(place, how), key=list(HOW).index)
    groups = _joined({place: files for place, files in groups.items() if files}, ways)
    out = [Trial(_ordered(files, names), ways[place], place) for place, files in groups.items()]
    if not any(len(trial.files) > 1 for trial in out):
        in_folders = {p for t in out if "*" in t.place.rpartition("/")[0] for p in t.files.values()}
        several = len({camera for t in out for camera, p in t.files.items() if p in in_folders}) > 1
        unnamed = [path for path in paths if not (several and path in in_folders)]
        whole, rest = _unnamed(unnamed, folder, names, sizes or {}, wanted or {})
        if whole:
            out, left = whole, rest
    return sorted(out, key=lambda t: (-len(t.files), natural(t.place))), left


def camera_of(path: Path, folder: Path, names: Sequence[str]) -> tuple[str, str, str] | None:
    """Camera, way (of `HOW`) and place of one file: from its own name, else from the folders above it."""
    parts = list(path.relative_to(folder).parts)
    parts[-1] = PurePath(parts[-1]).stem if not path.is_dir() else parts[-1]
    for find, how in ((_by_name, "name"), (_by_number, "number")):
        for level in range(len(parts) - 1, -1, -1):
            found = find(parts[level], names)
            if found:
                camera, (start, stop) = found
                star = f"{parts[level][:start]}*{parts[level][stop:]}"
                return camera, how, "/".join([*parts[:level], star, *parts[level + 1 :]])
    return None


def _by_name(text: str, names: Sequence[str]) -> tuple[str, tuple[int, int]] | None:
    """The longest camera name that is a word of a text, or follows "cam" in it: "vid1-camA" for "A"."""
    for name in sorted(names, key=len, reverse=True):
        word = rf"{_CAMERA_WORD}[\s_-]*"
        short = len(name) < (3 if name.isdigit() else 2) and name.lower() != text.lower()
        word = word if short else f"(?:{word})?"  # a short name alone may be part of a date, or an article
        match = re.search(rf"(?<![A-Za-z0-9]){word}{re.escape(name)}(?![A-Za-z0-9])", text, re.IGNORECASE)
        if match:
            return name, match.span()
    return None


_MAX_DIGITS = 18  # of a camera's number: serial numbers have fewer


def camera_number(name: str) -> int | None:
    """The last number in a camera's name."""
    found = re.findall(r"\d+", name)
    return int(found[-1][-_MAX_DIGITS:]) if found else None


def _by_number(text: str, names: Sequence[str]) -> tuple[str, tuple[int, int]] | None:
    numbers = {camera_number(name): name for name in names}
    if None in numbers or len(numbers) < len(names):
        return None
    for match in _NUMBERED.finditer(text):
        if int(match[1][-_MAX_DIGITS:]) in numbers:
            return numbers[int(match[1][-_MAX_DIGITS:])], match.span()
    return None


def _joined(groups: dict[str, dict[str, Path]], ways: dict[str, str]) -> dict[str, dict[str, Path]]:
    """Join places that differ only in the file's own name, unless a camera would be there twice."""
    above: dict[str, list[str]] = defaultdict(list)
    for place in groups:
        above[place.rpartition("/")[0]].append(place)
    out: dict[str, dict[str, Path]] = {}
    for parent, places in above.items():
        cameras = [camera for place in places for camera in groups[place]]
        counted: dict[str, list[Path]] = defaultdict(list)
        for camera, path in (item for place in places for item in groups[place].items()):
            counted[camera].append(path)
        lengths = {len(files) for files in counted.values()}
        if "*" in parent and len(counted) > 1 and max(lengths) > 1 and all(
            COUNTED.fullmatch(path.stem) for files in counted.values() for path in files
        ):  # folders are the cameras', and each camera counts its own files
            for k in range(max(lengths)):
                place = f"{parent}/*" if k == 0 else f"{parent}/* ({k + 1})"
                out[place] = {camera: files[k] for camera, files in counted.items() if k < len(files)}
                ways[place] = "nth" if len(lengths) == 1 else "uneven"
            continue
        if len(places) == 1 or len(set(cameras)) < len(cameras):
            out |= {place: groups[place] for place in places}  # several recordings
            continue
        key = parent if "*" in parent else f"{parent}/*".lstrip("/")
        out[key] = {camera: path for place in places for camera, path in groups[place].items()}
        ways[key] = max((ways[place] for place in places), key=list(HOW).index)
    return out


def _unnamed(
    paths: list[Path], folder: Path, names: Sequence[str], sizes: Mapping[Path, object], wanted: Mapping[str, object]
) -> tuple[list[Trial], list[Path]]:
    """Assign files without a camera's name: by numbers that count from another start, by size, by order."""
    by_folder: dict[Path, list[Path]] = defaultdict(list)
    for path in sorted(paths, key=lambda p: natural(str(p))):
        by_folder[path.parent].append(path)
    whole, rest = [], []
    for parent, group in by_folder.items():
        place = "/".join([*parent.relative_to(folder).parts, "*"])
        if len(group) != len(names):
            rest += group
            continue
        if len(set(wanted.values())) == len(names) == len({sizes.get(p) for p in group} & set(wanted.values())):
            files = {camera: next(p for p in group if sizes.get(p) == size) for camera, size in wanted.items()}
            whole.append(Trial(_ordered(files, names), "size", place))
            continue
        shifted = _shifted([camera_number(path.stem) for path in group], [camera_number(name) for name in names])
        if shifted:
            group = sorted(group, key=lambda path: camera_number(path.stem) or 0)
        cameras = sorted(names, key=(lambda name: camera_number(name) or 0) if shifted else natural)
        files = dict(zip(cameras, group))
        whole.append(Trial(_ordered(files, names), "shifted" if shifted else "order", place))
    return whole, rest


def _shifted(found: Sequence[int | None], there: Sequence[int | None]) -> bool:
    """Whether two lists of numbers differ by a constant."""
    a, b = sorted(n for n in found if n is not None), sorted(n for n in there if n is not None)
    return len(a) == len(found) and len(b) == len(there) and len({m - n for m, n in zip(a, b)}) == 1


def _ordered(files: Mapping[str, Path], names: Sequence[str]) -> dict[str, Path]:
    return {name: files[name] for name in names if name in files}
