"""What the keys of a camera's table mean: its quantities, the lens and conventions that it states, what is unread."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError

Table = dict[str, Any]

_TO_CAMERA = r"w(?:orld)?(?:2|to)c(?:am(?:era)?)?|tc(?:am(?:era)?)?w(?:orld)?"
_TO_WORLD = r"c(?:am(?:era)?)?(?:2|to)w(?:orld)?|tw(?:orld)?c(?:am(?:era)?)?"
_OPENGL = r"opengl|gl|blender|nerf(?:studio)?|instantngp|pyrender|arkit"  # right, up, looking along -z
_OPENCV = r"opencv|cv|colmap"
_AS_HERE = re.compile(
    r"convention|coordinates?|system|camera|axes|world|matrix|pose|extrinsics?|righthand(?:ed)?|x?right|y?down|z?forward|"
    r"rowmajor|rodrigues|axisangle|rotationvector|radians?|rad|k1k2p1p2(?:k3)?"
)
"""Words of a convention that say nothing, or what kinefit assumes."""
_VALUES = r"(?:coef(?:f(?:icient)?)?|vec(?:tor)?|par(?:am(?:eter)?)?|value)?s?"
_KEYS = {
    kind: re.compile(pattern)
    for kind, pattern in {
        "matrix": r"(?:cam(?:era)?|intrinsics?)?matrix|intrinsics?(?:parameters)?|[km]|mtx",
        "distortion": rf"(?:lens|cam(?:era)?)?dist(?:ort(?:ion)?s?)?{_VALUES}|coef(?:f(?:icient)?)?s?|kc|d",
        "radial": rf"(?:lens)?radial(?:dist(?:ortion)?)?{_VALUES}|dist(?:ortion)?coeffk",
        "tangential": rf"(?:lens)?tangenti?al(?:dist(?:ortion)?)?{_VALUES}|dist(?:ortion)?coeffp",
        "size": r"(?:image|img|frame)?size|(?:image)?resolution",
        "shape": r"(?:image|img|frame)shape",  # as numpy has it: (height, width)
        "width": r"(?:image|img|frame)?width|w",
        "height": r"(?:image|img|frame)?height|h",
        "rotation": r"(?:extrinsics?)?r(?:ot(?:ation)?)?(?:mat(?:rix)?|vec(?:tor)?)?",
        "translation": r"(?:extrinsics?)?t(?:rans(?:lation)?)?(?:vec(?:tor)?)?",
        "pose": rf"extrinsics?(?:matrix|parameters)?|rt|(?:{_TO_CAMERA})(?:matrix)?",
        "inverse pose": rf"cameraposematrix|(?:{_TO_WORLD})(?:matrix)?",
        "lens model": r"(?:distortion|projection)(?:model|type)|projection",
        "model": r"(?:camera|lens)?(?:model|type)|modeltype|lens",
        "fisheye": r"(?:is|use)?fisheye(?:model|lens|camera)?",
        "unit": r"(?:length|world|translation|position)?units?(?:oflength)?",
        "fx": r"fl?x", "fy": r"fl?y", "cx": r"cx|ppx", "cy": r"cy|ppy", "skew": r"skew",
        "coefficient": r"k[1-6]|p[12]",
    }.items()
}  # fmt: skip
_CONVENTION = re.compile(
    r"convention|coordinate|handed|degree|radian|(?:angle|rvec|rotation)s?units?|opengl|opencv|blender|unity|unreal|pytorch3d|"
    r"flip|mirrored|transposed|rowvector|columnmajor|invert|^inversed?$|(?:rotation|euler|quat(?:ernion)?|axis|matrix|"
    r"dist(?:ortion)?|coef\w*)order|(?:extrinsics?|pose|rotation|transform|matrix)(?:type|format|direction)|axes$|"
    rf"^(?:is)?(?:{_TO_CAMERA}|{_TO_WORLD})$"
)
"""Keys whose text or truth says how numbers are to be understood."""
_SAYS_IT = re.compile(rf"(?:opengl|lefthanded|{_TO_CAMERA}|{_TO_WORLD})+")
"""Texts that say so under any key."""
_LENS = re.compile(r"distor|distco|radial|tangen|coef|prism|fisheye|omni|^xi$|^[ksb]\d+$|^tau[xy]?$")
_POSE = re.compile(r"rot|trans|pose|extrin|orient|position|quat|euler|cent(?:er|re)|^[qrt]\d*$")
_POSE_SCALAR = re.compile(r"q[wxyz]|[tr][xyz]|yaw|pitch|roll")
_SCALE = re.compile(r"^(?:world|pose|translation)?scale(?:factor)?$")
_HARMLESS = re.compile(
    r"err|rms|residual|std|deviation|sigma|covar|uncertain|^num|count|estimate|fix|flag|views|points|board|pattern|"
    r"square|vectors|matrices|roi|^new|optimal|rectif|projectionmatrix|resolutions|exposure|gain|plane|time"
)
"""Further keys of a camera that never change how it projects: quality, boards, settings of the program."""
_LENS_SIZES = (4, 5, 8, 12, 14)  # of OpenCV's vectors of distortion
_FISHEYE = ("fisheye", "equidistant", "kannalabrandt", "kb4", "kb8")
_OPENCV_LENS = re.compile(
    r"|none|0|(?:simple)?(?:pinhole|radial)|perspective|rad(?:ial)?tan(?:gential)?|plumbbob|(?:full)?opencv|standard|"
    r"(?:opencv)?(?:brown(?:conrady)?|rational)(?:polynomial)?5?"
)  # 0: of MC-Calib, which has 1 for fisheye
_OTHER_LENS = re.compile(
    r"omnidir|unified|doublesphere|eucm|division|scaramuzza|ocamcalib|thinprism|ftheta|inverse|modified|equirect|"
    r"spherical|panoram|orthograph|stereograph|equisolid|^(?:ds|ucm|mei|fov|omni|ocam)$"
)
_NO, _YES = ("false", "no", "0", "00", "none", ""), ("true", "yes", "1", "10")  # of 0.0 and 1.0, too


def spelled(key: Any) -> str:
    """A key or text in lower case, letters and digits alone."""
    return re.sub(r"[\W_]", "", str(key)).lower()


@cache
def kind_of(key: str) -> str | None:
    """The quantity that a key names, see `_KEYS`; None for any other."""
    name = spelled(key)
    return next((kind for kind, pattern in _KEYS.items() if pattern.fullmatch(name)), None)


def find_all(table: Table, kind: str) -> list[Any]:
    """Values in a table under any of the names of a quantity, see `_KEYS`; poses are matrices or tables, not flags."""
    found = [value for key, value in table.items() if kind_of(str(key)) == kind]
    return [value for value in found if isinstance(value, list | dict)] if kind.endswith("pose") else found


def find(table: Table, kind: str) -> Any:
    """First value in a table under any of the names of a quantity, see `_KEYS`; None if there is none."""
    return next(iter(find_all(table, kind)), None)


def statements(tree: Any) -> Table:
    """Entries of a table, and of its `metadata`, that hold for all cameras in it: lens model, unit, conventions."""
    if not isinstance(tree, dict):
        return {}
    own = {}
    for key, value in tree.items():
        is_kind = kind_of(str(key)) in ("lens model", "model", "fisheye", "unit") or _SCALE.search(spelled(key))
        if _states_convention(key, value) or (is_kind and not isinstance(value, list | dict)):
            own[key] = value
    return statements(tree.get("metadata")) | own


def _states_convention(key: Any, value: Any) -> bool:
    """Whether an entry is a text, a flag or a list of texts on how numbers are to be understood."""
    texts = value if isinstance(value, list) and value else [value]
    is_text = value in (0, 1) or all(isinstance(text, str) for text in texts)
    return bool(is_text and (_CONVENTION.search(spelled(key)) or _SAYS_IT.fullmatch(spelled(value))))


def conventions(table: Table) -> set[str]:
    """What a table says of its poses: "c2w", "w2c", "opengl" (a camera looks along -z, y up), "opencv".

    Raises
    ------
    CalibrationError
        A convention that kinefit does not know, or two that contradict each other.
    """
    said: set[str] = set()
    for key, value in table.items():
        name, text = spelled(key), spelled(value)
        if not _states_convention(key, value):
            continue
        if text in _NO:
            text = "c2w" if re.search(_TO_CAMERA, name) else "not" if re.search("opencv|right", name) else ""
        elif text in _YES:
            text = name.removeprefix("is")
        for what, words in (("w2c", _TO_CAMERA), ("c2w", _TO_WORLD), ("opengl", _OPENGL), ("opencv", _OPENCV)):
            text, count = re.subn(words, "", text)
            said |= {what} if count else set()
        if _AS_HERE.sub("", text):
            raise CalibrationError(
                f"kinefit does not know what {key} = {value!r} means",
                remedy="Give poses from world to camera, which looks along z, y down, rotation vectors in radians, and "
                'write "opencv"; "opengl", "c2w" and "w2c" are read, too.',
            )  # fmt: skip
    for pair in ({"c2w", "w2c"}, {"opengl", "opencv"}):
        if pair <= said:
            problem = f"its conventions contradict each other: {' and '.join(sorted(pair))}"
            raise CalibrationError(problem, remedy="Remove the wrong one.")
    return said


def lens_model(table: Table) -> str:
    """Model of a table's lens: "radtan" or "fisheye".

    Raises CalibrationError for another model. `model` and `type` may name a product, which is no lens model.
    """
    fisheye, given = any(spelled(value) in _YES for value in find_all(table, "fisheye")), find(table, "distortion")
    for kind in ("lens model", "model"):
        for value in find_all(table, kind):
            text = spelled(value) if isinstance(value, str | int | float) else ""
            known = _OPENCV_LENS.fullmatch(text) or text == "1" or any(word in text for word in _FISHEYE)
            if re.search("inverse|modified", text) and given is not None and not _numbers(given).any():
                continue  # as RealSense's colour cameras have it
            if _OTHER_LENS.search(text) or (kind == "lens model" and not known):
                remedy = "Undistort the videos, or calibrate again with OpenCV's model: k1, k2, p1, p2, k3, or fisheye."
                raise CalibrationError(f"a lens of the model {value}", remedy=remedy)
            fisheye |= any(word in text for word in _FISHEYE) or (kind == "lens model" and text == "1")
    return "fisheye" if fisheye else "radtan"


def refuse_unread(table: Table, *, has_lens: bool, has_pose: bool) -> None:
    """Raise CalibrationError for a key that speaks of the lens, the pose or the scale and that kinefit does not read.

    Parameters
    ----------
    has_lens : whether distortion was read; if not, any vector as long as one of OpenCV's may be it.
    has_pose : whether a pose was read, or none is wanted; if not, anything that may be one is refused.
    """
    for key, value in table.items():
        name, values = spelled(key), _numbers(value)
        unused = name.endswith("undistorted") and not has_lens
        if kind_of(str(key)) or not values.any() or unused or _HARMLESS.search(name):
            continue
        may_be_pose = (values.size >= 3 and _POSE.search(name)) or _POSE_SCALAR.fullmatch(name)
        may_be_lens = not has_lens and not may_be_pose and values.size in _LENS_SIZES and np.any(values % 1)
        if may_be_lens or _LENS.search(name):
            subject, remedy = "lens", "Write OpenCV's k1, k2, p1, p2, k3 as dist"
        elif may_be_pose and not has_pose:
            subject, remedy = "pose", "Write R (3, 3) and t (3), world to camera"
        elif _SCALE.fullmatch(name) and np.any(values != 1):
            subject, remedy = "unit of length", 'Apply it to the translations, or write unit = "mm"'
        else:
            continue
        problem = f"kinefit does not read {key}, which may be its {subject}"
        raise CalibrationError(problem, remedy=f"{remedy}; remove {key} if it is none.")


def _numbers(value: Any) -> NDArray:
    """Numbers of a value, flat; none where it is anything else."""
    try:
        return np.array(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)
