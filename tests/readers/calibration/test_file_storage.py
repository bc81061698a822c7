"""OpenCV's YAML and XML: the values that OpenCV gives, in operations that grow with the length of the file."""

import re
import sys

import cv2
import numpy as np
import pytest

from kinefit.errors import CalibrationError, FileError
from kinefit.readers.calibration import read
from kinefit.readers.calibration.file_storage import storage_of_xml, storage_of_yaml
from kinefit.readers.calibration.read import read_calibration, recognise

CAMERA = "cam:\n  K: [ [ 50., 0., 32. ], [ 0., 50., 24. ], [ 0., 0., 1. ] ]\n  size: [ 64, 48 ]\n"


def opencv(node):
    if node.isMap():
        return {key: opencv(node.getNode(key)) for key in node.keys()}
    if node.isSeq():
        return [opencv(node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() else int(node.real()) if node.isInt() else None


def parsed_by_opencv(text, kind):
    flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    storage = cv2.FileStorage(text, flags | (cv2.FILE_STORAGE_FORMAT_YAML if kind == "yaml" else 0))
    return opencv(storage.root())  # of which nothing is left without the storage


PARSERS = {"yaml": storage_of_yaml, "xml": storage_of_xml}


@pytest.mark.parametrize("kind", PARSERS)
def test_what_opencv_writes_is_read_as_opencv_reads_it(kind):
    rng = np.random.default_rng(0)
    ending = f".{kind}"
    storage = cv2.FileStorage(ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for k in range(3):
        storage.startWriteStruct(f"camera{k}", cv2.FileNode_MAP)
        storage.write("matrix", rng.normal(size=(3, 3)) * 10.0 ** rng.integers(-300, 300, (3, 3)))
        storage.write("vector", np.arange(40))
        storage.write("floats", rng.normal(size=(2, 50)).astype(np.float32))
        storage.write("text", "a 'b' # c: d, <e> & \\f\n\tg" + (' "h"' if kind == "yaml" else ""))
        values = {"number": "1.5", "word": "plain", "nothing": "", "nan": float("nan"), "tiny": -1e-320}
        for name, value in values.items():
            storage.write(name, value)
        storage.write("texts", ["a b", "c"])
        storage.startWriteStruct("mixed", cv2.FileNode_SEQ)
        storage.write("", np.eye(2))
        storage.write("", 3)
        for flow in (cv2.FileNode_MAP, cv2.FileNode_SEQ):
            storage.startWriteStruct("", flow | cv2.FileNode_FLOW)
            storage.write("" if flow == cv2.FileNode_SEQ else "q", 1.5)
            storage.write("" if flow == cv2.FileNode_SEQ else "r", "z w")
            storage.endWriteStruct()
        storage.endWriteStruct()
        storage.endWriteStruct()
    text = storage.releaseAndGetString()
    assert repr(PARSERS[kind](text)) == repr(parsed_by_opencv(text, kind))


@pytest.mark.parametrize(
    "text",
    ["a: 1.", "a: .5", "a: -.Inf", "a: +1", "a: 'it''s'", 'a: "q\\"x\\n"', "a: { b: 1, c: [ 2. ] }", "a:5", "a: []",
     "a: {}", "a b: 3", "a:\n  - 1\n  - b: 2\n    c: 3\n  - [1,2]", "- a: 1\n- a: 2", "a: !!float 3",
     "a:\n   b: 1\n\n   # hi\n   c: 2\nd: 3"],
)  # fmt: skip
def test_yaml_by_hand_is_read_as_opencv_reads_it(text):
    text = f"%YAML:1.0\n---\n{text}\n"
    assert repr(storage_of_yaml(text)) == repr(parsed_by_opencv(text, "yaml"))


def test_yaml_that_opencv_cannot_read():
    assert storage_of_yaml("%YAML:1.0\n---\na: null\n") == {"a": None}  # a text to OpenCV 4.11, not to 5.0
    assert storage_of_yaml("a:\n- 1\n- 2\n'b c': x # remark\n") == {"a": [1, 2], "b c": "x"}
    assert storage_of_yaml("a: &b [1]\nc: &d 2\n") == {"a": [1], "c": 2}
    assert storage_of_yaml("a: |\n  x: 1\n  y\n") == {"a": "x: 1\ny"}
    assert storage_of_yaml("a: { b:1, c:'d, e:f' } # g:h\n") == {"a": {"b": 1, "c": "d, e:f"}}
    assert storage_of_yaml("a: [ 1, # one\n  2,\n]\r\nb: 1 2 3") == {"a": [1, 2], "b": "1 2 3"}


@pytest.mark.parametrize(
    ("text", "told"),
    [("a: 1\n  b: 2", "line 2: mapping values are not allowed"), ("a: 1\na: 2", "line 2: the key 'a' appears twice"),
     ("a: *b", "line 1: found undefined alias"), ("a: &b [1]\nc: *b", "line 1: an anchor that is used again"),
     ("a: &b [*b]", "an anchor that is used again"), ('a: "x', "unexpected end of stream"), ("a: - b", "line 1: block"),
     ("a: [1, {b: 2]", "line 1: did not find expected ',' or '}'"), ("a: [1", "did not find expected"),
     ("a:\n  b: 1\n c", "line 3: did not find expected key"), ("x: {[1]: 2}", "line 1: the key"),
     ("a: " + "[" * 900 + "]" * 900, "nested too deeply"),
     ("a: \0", "not allowed")],
)  # fmt: skip
def test_broken_yaml_is_told_with_its_line(tmp_path, text, told):
    (tmp_path / "a.yml").write_text(f"%YAML:1.0\n{text}\n")
    told = re.sub(r"line (\d)", lambda line: f"line {int(line[1]) + 1}", told)
    with pytest.raises(CalibrationError, match=f"not a readable YAML file: .*{re.escape(told)}"):
        read_calibration(tmp_path / "a.yml")


@pytest.mark.parametrize(
    ("text", "told"),
    [("<a>1</a><a>2</a>", "<a> twice"), ("<a>" * 9000 + "</a>" * 9000, "nested too deeply"), ("<a>", "mismatched tag")],
)
def test_broken_xml_is_told(tmp_path, text, told):
    (tmp_path / "a.xml").write_text(f"<opencv_storage>{text}</opencv_storage>")
    with pytest.raises(CalibrationError, match=told):
        read_calibration(tmp_path / "a.xml")


def test_entities_are_refused_before_they_are_expanded(tmp_path, monkeypatch):
    laughs = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(9))
    text = f'<!DOCTYPE a [<!ENTITY l0 "ha">{laughs}]><opencv_storage><a>&l9;</a></opencv_storage>'
    (tmp_path / "a.xml").write_text(text)
    monkeypatch.setattr("xml.etree.ElementTree.fromstring", lambda *_: pytest.fail("they would be expanded"))
    with pytest.raises(CalibrationError, match="a document type"):
        read_calibration(tmp_path / "a.xml")


def test_anchors_are_refused_before_they_are_expanded():
    laughs = "l0: &l0 [ha]\n" + "".join(f"l{k + 1}: &l{k + 1} [{', '.join([f'*l{k}'] * 10)}]\n" for k in range(99))
    with pytest.raises(ValueError, match="line 1: an anchor"):
        storage_of_yaml(laughs)


def operations(function, *arguments):
    """Calls of Python and C that a function takes."""
    count = 0

    def counted(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(counted)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return count


NUMBERS = {
    "yaml": lambda n: f"%YAML:1.0\n---\n{CAMERA}x: [ {', '.join(f'{k}.5' for k in range(n))} ]\n",
    "yaml lines": lambda n: f"%YAML:1.0\n---\n{CAMERA}x:\n" + "".join(f"  - {k}.5\n" for k in range(n)),
    "yaml tables": lambda n: f"%YAML:1.0\n---\n{CAMERA}" + "".join(f"k{k}: {{ a: 1 }}\n" for k in range(n)),
    "xml": lambda n: f"<opencv_storage><x>{' '.join(f'{k}.5' for k in range(n))}</x></opencv_storage>",
    "xml tables": lambda n: f"<opencv_storage>{''.join(f'<k{k}>1</k{k}>' for k in range(n))}</opencv_storage>",
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_operations_grow_with_the_length(kind, monkeypatch):
    monkeypatch.setattr(cv2, "FileStorage", lambda *_: pytest.fail("its sequences take the square of their length"))
    parse = PARSERS[kind.split()[0]]
    few, many = (operations(parse, NUMBERS[kind](n)) for n in (1000, 4000))
    assert many < 4.5 * few and many < 60 * 4000


def test_blank_lines_are_passed_over_once(monkeypatch):
    text, matches = "# by hand\n" + "\n" * 3000 + CAMERA, []
    search = re.search

    def recorded(pattern, *arguments):
        matches.append(pattern)
        return search(pattern, *arguments)

    monkeypatch.setattr(read.re, "search", recorded)
    assert recognise(text, None) == "yaml" and matches
    for pattern in matches:  # one that runs from line to line is tried anew at each of them
        assert not any(found[0].count("\n") for found in re.finditer(pattern, "\n\n\na = 1\n\n[b]\n\nc: 1\n", re.M))


def test_a_file_larger_than_any_calibration_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "a.yml"
    with path.open("wb") as file:
        file.truncate(read.MAX_CALIBRATION_BYTES + 1)
    monkeypatch.setattr(type(path), "read_text", lambda *_, **__: pytest.fail("it is read"))
    with pytest.raises(FileError, match="too large for a calibration"):
        read_calibration(path)


def test_more_cameras_than_any_rig_are_refused(tmp_path):
    lines = "".join(CAMERA.replace("cam", f"c{k}") for k in range(1001))
    (tmp_path / "a.yml").write_text(lines)
    with pytest.raises(CalibrationError, match="1001 cameras, more than 1000"):
        read_calibration(tmp_path / "a.yml")
