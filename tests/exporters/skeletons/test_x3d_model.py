"""X3D against the object model of the Web3D Consortium: its own Python package checks every node, field and value.

The package is made from the same X3D Unified Object Model as the official schema, which no package registry has.
"""

import xml.etree.ElementTree as ET

import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.exporters import write_x3d

x3d = pytest.importorskip("x3d.x3d")

WIDTH = {"SFVec3f": 3, "SFRotation": 4, "SFColor": 3, "MFVec3f": 3, "MFRotation": 4, "MFColor": 3}


def value(text, kind):
    """A field's value, as the package takes it, from an attribute's text."""
    if kind in ("SFString", "MFString", "SFNode"):
        return text
    if kind == "SFBool":
        return {"true": True, "false": False}[text]
    numbers = [int(one) if kind.endswith("Int32") else float(one) for one in text.split()]
    if kind in ("SFFloat", "SFDouble", "SFTime", "SFInt32"):
        (number,) = numbers
        return number
    if kind in WIDTH:
        rows = [tuple(numbers[k : k + WIDTH[kind]]) for k in range(0, len(numbers), WIDTH[kind])]
        return rows if kind.startswith("MF") else rows[0]
    return numbers


def built(element):
    """The package's node of an element, with all that is in it: what is not in the model raises."""
    kind = getattr(x3d, element.tag)
    fields = {field[0]: field[2].__name__ for field in kind.FIELD_DECLARATIONS()}
    given = {}
    for name, text in element.attrib.items():
        if name != "containerField" and not name.startswith("{"):
            given[name] = value(text, fields[name])
    for child in element:
        default = getattr(x3d, child.tag)
        usual = default.CONTAINERFIELD_DEFAULT() if hasattr(default, "CONTAINERFIELD_DEFAULT") else "children"
        place = child.get("containerField", usual)
        if element.tag == "X3D":
            place = child.tag
        if fields[place] == "MFNode":
            given.setdefault(place, []).append(built(child))
        else:
            assert place not in given, f"two {place} in {element.tag}"
            given[place] = built(child)
    return kind(**given)


@pytest.mark.parametrize("name", ["humanoid", "snowboarder", "rower"])
def test_every_node_field_and_value_is_in_the_model(tmp_path, capsys, name):
    motion = smooth_motion(4, up="z", turns=0.6, body=load_body(name))
    write_x3d(motion, tmp_path / "a.x3d")
    capsys.readouterr()
    scene = built(ET.parse(tmp_path / "a.x3d").getroot())
    again = ET.fromstring("".join(scene.XML().partition("<X3D")[1:]))
    joints = {node.get("DEF") for node in again.iter("HAnimJoint")} - {None}
    misnamed = {line for line in capsys.readouterr().out.splitlines() if "isValidHAnimDEF" in line}
    assert all("_joint does not" in line for line in misnamed), misnamed  # where H-Anim has no name for the joint
    assert len(joints) == len(motion.body.tree.segments)
    assert len(list(again.iter("ROUTE"))) == len(list(ET.parse(tmp_path / "a.x3d").getroot().iter("ROUTE")))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('loop="true"', 'loop="yes"'), ("center=", "centre="), ('profile="Immersive"', 'profile="Everything"'),
        ("<HAnimSegment", "<HAnimSegement"), ('vertexCount="', 'vertexCount="0.5 '), ("<LineSet", '<LineSet name="2"'),
    ],
)
def test_what_is_not_in_the_model_is_found(tmp_path, old, new):
    write_x3d(smooth_motion(2, up="z", turns=0.6), tmp_path / "a.x3d")
    text = (tmp_path / "a.x3d").read_text()
    assert old in text
    close = ("</HAnimSegment", "</HAnimSegement") if "Segement" in new else ("\0", "")
    with pytest.raises((x3d.X3DTypeError, x3d.X3DValueError, KeyError, AttributeError, ValueError)):
        built(ET.fromstring(text.replace(old, new).replace(*close).encode()))
