"""Inputs of users: keypoints and videos. Each case of `cases_of_users` that is answered rightly, and siblings of it."""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

import kinefit
from benchmarks.accuracy.people.people_real import take_of
from benchmarks.commands import QUIET, answer
from benchmarks.figures import data
from benchmarks.scenes.simulated import rows_of
from kinefit.errors import ObservationError
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.landmarks.keypoints import read_keypoints, read_openpose
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video import Video
from kinefit.takes.missing import prepared

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
SIZE = (160, 96)
BLAMES = ("has moved", "is late", "later than", "scale is wrong", "session")  # cameras, which are right


@contextmanager
def copied(folder: Path) -> Iterator[Path]:
    """A copy of a case that may be written into."""
    with tempfile.TemporaryDirectory() as where:
        yield Path(shutil.copytree(folder, Path(where) / "case"))


def recording(name: str) -> Path:
    """A shared recording."""
    folder = data(name)
    assert folder is not None, f"no recording {name}"
    return folder


# ---- keypoints


def arrays() -> list[NDArray]:
    """MediaPipe's arrays (100, 33, 3) of the balancing trial."""
    return [np.load(recording("video_balancing_4cam") / f"mediapipe_landmarks_{c}.npy") for c in CAMERAS]


def openpose() -> list[NDArray]:
    """The man's points (100, 25, 3) of the balancing trial, of OpenPose's BODY_25B."""
    folder = recording("video_balancing_4cam")
    records = [read_openpose(folder / "openpose_json" / c, camera=c, rate=60.0) for c in CAMERAS]
    calibration = kinefit.read_calibration(folder / "Calib_refined_static.toml")
    man = kinefit.Recording.of_keypoints(calibration.select(CAMERAS), records).keypoints
    return [rows_of(k) for k in man]


def write_take(folder: Path, cameras: Sequence[Sequence[NDArray]], *, keys: str = "", array: bool = False) -> Path:
    """A take of the people's points (F, K, 3) in each camera, as OpenPose's json, or as arrays of one person."""
    text = '[take]\nrate = 60.0\nup = "z"\n[calibration]\nfile = "calibration.toml"\n'
    shutil.copy(recording("video_balancing_4cam") / "Calib_refined_static.toml", folder / "calibration.toml")
    for camera, people in zip(CAMERAS, cameras, strict=True):
        text += f'[[camera]]\nname = "{camera}"\n[[keypoints]]\ncamera = "{camera}"\nsigma = 10.0\n{keys}'
        if array:
            np.save(folder / f"{camera}.npy", people[0])
            text += f'format = "mediapipe"\nfile = "{camera}.npy"\n'
            continue
        (folder / camera).mkdir()
        text += f'file = "{camera}"\n'
        for i, frame in enumerate(zip(*people, strict=True)):
            found = [{"pose_keypoints_2d": one.ravel().tolist()} for one in frame if one.any()]
            (folder / camera / f"{camera}_{i:06d}_keypoints.json").write_text(json.dumps({"people": found}))
    (folder / "take.toml").write_text(text)
    return folder / "take.toml"


def stops(take: Path, *words: str) -> bool:
    """Whether `track` and `check` say these words, and blame no camera."""
    status, told = answer("track", take, *QUIET)
    checked = answer("check", take)[1]
    is_said = all(word in told and word in checked for word in words)
    return status != 0 and is_said and not any(blame in told + checked for blame in BLAMES)


def _no_visibility(folder: Path) -> bool:
    with copied(folder) as case:
        return stops(case / "take.toml", "no confidence or visibility", "% of them below 0", "depth")


def _third(change: Callable[[NDArray], NDArray], *, array: bool = True) -> list[list[NDArray]]:
    """The recording with another third value."""
    return [[np.dstack([a[..., :2], change(a[..., 2])])] for a in (arrays() if array else openpose())]


def _logits(folder: Path) -> bool:
    share = lambda v: np.clip(v, 1e-4, 1 - 1e-4)
    take = write_take(folder, _third(lambda v: np.log(share(v) / (1 - share(v)))), array=True)
    return stops(take, "no confidence or visibility", "logits")


def _metres(folder: Path) -> bool:
    take = write_take(folder, _third(lambda v: np.where(v > 0, 2.0 + v, 0.0), array=False), keys='set = "BODY_25B"\n')
    return stops(take, "no confidence or visibility", "depth")


def _percentages(folder: Path) -> bool:
    take = write_take(folder, _third(lambda v: np.where(v > 0, np.rint(100 * v), 0.0), array=False))
    return stops(take, "no confidence or visibility", "divide them by 100")


def _record(folder: Path) -> bool:
    names = KEYPOINT_SETS["MEDIAPIPE_33"]
    uv = arrays()[0][:, None, :, :2]
    try:
        Keypoints("cam01", "MEDIAPIPE_33", names, 60.0, uv, uv[..., 0] - uv[..., 0].mean())
    except ObservationError as error:
        return "no confidence" in error.problem
    return False


def _shares(folder: Path) -> bool:
    cameras = [[np.dstack([a[..., 0] / 1088, a[..., 1] / 1920, a[..., 2]])] for a in openpose()]
    return stops(write_take(folder, cameras), "from 0 to 1", "Multiply x by the image's width")


def _flags(folder: Path) -> bool:
    cameras = _third(lambda v: np.where(v > 0.6, 2.0, np.where(v > 0, 1.0, 0.0)), array=False)
    status, told = answer("track", write_take(folder, cameras), *QUIET, "--out", folder / "out")
    return status == 0 and "fault" not in told


def _body_25(folder: Path) -> bool:
    with copied(folder) as case:
        status, told = answer("track", case / "take.toml", *QUIET, "--out", case / "out")
        tall = kinefit.read_motion(case / "out" / "motion.npz").body.stature if status == 0 else 0.0
    return status == 0 and "fault" not in told and 1.6 < (tall or 0.0) < 1.9


def _stated_wrongly(folder: Path) -> bool:
    take = write_take(folder, [[a] for a in openpose()], keys='set = "BODY_25"\n')
    return stops(take, "the order of BODY_25B", 'set = "BODY_25B"')


def _in_order(folder: Path, columns: Sequence[int], *words: str) -> bool:
    """Whether `track` says of points in another order what they are, and blames no camera."""
    take = write_take(folder, [[a[:, columns]] for a in openpose()])
    told = answer("track", take, *QUIET, "--out", folder / "out")[1]
    return all(word in told for word in words) and not any(blame in told for blame in BLAMES)


def _shuffled(folder: Path) -> bool:
    return _in_order(folder, np.random.default_rng(0).permutation(25).tolist(), "not those of BODY_25")


def _human36m(folder: Path) -> bool:
    names = KEYPOINT_SETS["BODY_25B"]
    legs, arms = "RHip RKnee RAnkle LHip LKnee LAnkle", "LShoulder LElbow LWrist RShoulder RElbow RWrist"
    columns = [names.index(n) for n in f"LHip {legs} LHip UpperNeck UpperNeck HeadTop {arms}".split()]
    return _in_order(folder, columns, "not those of COCO_17", "order in which the points are written")


def _alphapose(folder: Path) -> bool:
    with copied(folder) as case:
        path = write_video(case / "cam1.mp4", range(20)).parent / "alphapose-results.json"
        return _is_read(path, "AlphaPose", 'format = "alphapose"')


def _is_read(path: Path, program: str, remedy: str) -> bool:
    """Whether a file is read, told where it is taken for OpenPose's, and named by `init` without a calibration."""
    status, told = answer("init", path.parent)
    seen = read_keypoints(path, camera="c", rate=30.0)
    try:
        read_keypoints(path, format="openpose", camera="c", rate=30.0)
    except ObservationError as error:
        said = program in error.problem and remedy in (error.remedy or "")
        named = status == 0 and f"{path.name}: not used" in told
        return said and named and seen.keypoint_set == "COCO_17" and bool(seen.confidence.any())
    return False


def _coco(folder: Path) -> bool:
    path = write_video(folder / "cam1.mp4", range(20)).with_name("person_keypoints.json")
    path.write_text(json.dumps([{"image_id": i, "category_id": 1, "keypoints": [5.0, 6.0, 2] * 17} for i in range(9)]))
    return _is_read(path, "COCO", 'format = "alphapose"')


def _deeplabcut(folder: Path) -> bool:
    path = write_video(folder / "cam1.mp4", range(20)).with_name("cam1DLC_resnet50.csv")
    path.write_text("scorer,net,net,net\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n0,1.0,2.0,0.9\n")
    seen = read_keypoints(path, camera="c", rate=30.0)
    return seen.points[0, 0, 0].tolist() == [1.0, 2.0] and f"{path.name}: not used" in answer("init", folder)[1]


# ---- several people


def _never_seen(folder: Path) -> bool:
    """Two real people by the built-in detector, as OpenPose's json without one eye and one ankle in any camera."""
    two = recording("video_two_people_4cam")
    take = prepared(read_take(take_of(two, two / "Calib.qca.txt", folder / "detected")))
    coco = [name for name in KEYPOINT_SETS["COCO_17"] if name not in ("LEye", "RAnkle")]
    cameras = []
    for camera in CAMERAS:
        k = read_detections(detections_file(take.path, camera)).keypoints(camera)
        spelled = {"Nose": "nose"} | {
            f"{s[0].upper()}{part}": f"{s}_{part.lower()}" for s in ("left", "right")
            for part in "Eye Ear Shoulder Elbow Wrist Hip Knee Ankle".split()
        }
        rows = np.nan_to_num(np.concatenate([k.points, k.confidence[..., None]], axis=-1))
        out = np.zeros((*rows.shape[:2], 17, 3))
        for name in coco:
            out[:, :, KEYPOINT_SETS["COCO_17"].index(name)] = rows[:, :, k.names.index(spelled[name])]
        cameras.append(list(out.transpose(1, 0, 2, 3)))
    path = write_take(folder, cameras, keys='set = "COCO_17"\n')
    path.write_text(path.read_text().replace("calibration.toml", str(two / "Calib.qca.txt")))
    return _two_people(path, folder)


def _never_seen_copy(folder: Path) -> bool:
    """The man and a copy of him at another time, without the top of the head in any camera."""
    cameras = [[a, np.roll(a, 50, axis=0)] for a in openpose()]
    for people in cameras:
        for one in people:
            one[:, KEYPOINT_SETS["BODY_25B"].index("HeadTop")] = 0.0
    return _two_people(write_take(folder, cameras), folder)


def _two_people(take: Path, folder: Path) -> bool:
    status, told = answer("track", take, *QUIET, "--out", folder / "out")
    motions = [folder / "out" / f"person-{k}" / "motion.npz" for k in (1, 2)]
    return status == 0 and "nan" not in told.lower() and all(path.is_file() for path in motions)


# ---- videos


def write_video(
    path: Path, shown: Sequence[int], codec: str = "mpeg4", size: tuple[int, int] = SIZE, *, bars: bool = True
) -> Path:
    """A video whose frames have their time [steps of 1/30 s] as bars, or four colours in the corners."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = 12, 0
        for i in shown:
            image = corners(size)
            if bars:
                for bit in range(8):
                    image[:, bit * size[0] // 8 : (bit + 1) * size[0] // 8] = 230 if i >> bit & 1 else 90
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def corners(size: tuple[int, int] = SIZE) -> NDArray:
    """An image with red, green, blue and white in its corners, row by row."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    colours = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255))
    for k, colour in enumerate(colours):
        rows, columns = divmod(k, 2)
        image[rows * size[1] // 2 :, columns * size[0] // 2 :][: size[1] // 2, : size[0] // 2] = colour
    return image


def shows(path: Path, shown: Sequence[int], *, numbers: bool = True) -> bool:
    """Whether a video has these frames at their times, in any order, and says how many are lacking."""
    lacking = shown[-1] - shown[0] + 1 - len(shown)
    with Video(path, rate=30.0) as video:
        read = [sum((image[48, 10 + 20 * b].mean() > 160) << b for b in range(8)) for image in video.frames()]
        right = len(video) == len(shown) and (read == list(shown) or not numbers)
        times = np.allclose(30.0 * video.times, np.array(shown) - shown[0], atol=1e-6)
        return right and times and (f"{lacking} frames lacking" in video.unevenness or not lacking)


def _avi(folder: Path) -> bool:
    return shows(folder / "cam.avi", [*range(20), *range(25, 60)], numbers=False)


def _avi_of(codec: str) -> Callable[[Path], bool]:
    shown = [i for i in range(60) if i not in (7, 8, 9, 30, 41, 42)]
    return lambda folder: shows(write_video(folder / "v.avi", shown, codec), shown)


def _avi_end(folder: Path) -> bool:
    path = write_video(folder / "v.avi", range(40), "mjpeg")
    raw = bytearray(path.read_bytes())
    raw[(at := raw.index(b"strh") + 40) : at + 4] = (45).to_bytes(4, "little")
    path.write_bytes(raw)
    return shows(path, range(40))


def _mirrored(folder: Path) -> bool:
    with Video(folder / "cam.mp4") as video:
        image = video.read(0).astype(int)
    return bool(image[10, -10, 0] > 200 > 60 > image[10, -10, 1:].max() and image[10, 10, 2] > 200)


SHOWN: dict[tuple[int, int, int, int], Callable[[NDArray], NDArray]] = {  # a, b, c, d of a display matrix
    (1, 0, 0, 1): lambda image: image, (0, 1, -1, 0): lambda image: np.rot90(image, -1),
    (-1, 0, 0, -1): lambda image: np.rot90(image, 2), (0, -1, 1, 0): np.rot90, (-1, 0, 0, 1): np.fliplr,
    (1, 0, 0, -1): np.flipud, (0, 1, 1, 0): lambda image: image.transpose(1, 0, 2),
    (0, -1, -1, 0): lambda image: np.rot90(image, 2).transpose(1, 0, 2),
}  # fmt: skip


def _matrices(suffix: str) -> Callable[[Path], bool]:
    def right(folder: Path) -> bool:
        raw = write_video(folder / f"v.{suffix}", range(5), bars=False).read_bytes()
        unity = np.array([65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30], ">i4").tobytes()
        at, good = raw.index(unity, raw.index(b"tkhd")), []
        for (a, b, c, d), shown in SHOWN.items():
            matrix = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 14]) * 65536
            (folder / f"m.{suffix}").write_bytes(raw[:at] + matrix.astype(">i4").tobytes() + raw[at + 36 :])
            good.append(_looks_like(folder / f"m.{suffix}", shown(corners())))
        return all(good)

    return right


def _looks_like(path: Path, image: NDArray) -> bool:
    with Video(path, rate=30.0) as video:
        seen = video.read(1)
        return video.size == image.shape[1::-1] and bool(np.abs(seen.astype(int) - image).mean() < 12)


def _photographs(folder: Path) -> bool:
    orders = dict(zip((1, 6, 3, 8, 2, 4, 5, 7), SHOWN.values(), strict=True))
    jpeg = cv2.imencode(".jpg", corners()[..., ::-1])[1].tobytes()
    good = []
    for orientation, shown in orders.items():
        tag = struct.pack(">4sIHHHIHHI", b"MM\0*", 8, 1, 0x112, 3, 1, orientation, 0, 0)
        exif = b"\xff\xe1" + struct.pack(">H", 8 + len(tag)) + b"Exif\0\0" + tag
        (folder / str(orientation)).mkdir()
        for i in range(2):
            (folder / str(orientation) / f"img{i}.jpg").write_bytes(jpeg[:2] + exif + jpeg[2:])
        good.append(_looks_like(folder / str(orientation), shown(corners())))
    return all(good)


def _no_alarm(folder: Path) -> bool:
    """Whether the recording as it is, of both detectors, is tracked without a fault."""
    told = []
    for array, of in ((False, openpose()), (True, arrays())):
        (folder / str(array)).mkdir()
        told.append(answer("track", write_take(folder / str(array), [[a] for a in of], array=array), *QUIET))
    return all(status == 0 and "no confidence" not in text for status, text in told)


CASES: dict[str, Callable[[Path], bool]] = {
    "keypoints-z-in-place-of-visibility": _no_visibility,
    "keypoints-normalised-z": _no_visibility,
    "openpose-body25-without-set": _body_25,
    "keypoints-alphapose-results": _alphapose,
    "video-avi-dropped-frames": _avi,
    "video-mirrored-flag": _mirrored,
}
"""{folder in cases_of_users: whether the answer to it is right}."""

SIBLINGS: dict[str, Callable[[Path], bool]] = {
    "third value: logits, an array": _logits,
    "third value: metres from the camera, OpenPose's json": _metres,
    "third value: percentages, OpenPose's json": _percentages,
    "third value: z in a record made in Python": _record,
    "third value: COCO's flags 0, 1, 2 are read": _flags,
    "third value: no alarm on two detectors' keypoints": _no_alarm,
    "coordinates: shares of the image, OpenPose's json": _shares,
    "set: BODY_25 stated of BODY_25B": _stated_wrongly,
    "set: Human3.6M's order of 17 points": _human36m,
    "set: 25 points in any order": _shuffled,
    "other programs: COCO's results": _coco,
    "other programs: DeepLabCut's table": _deeplabcut,
    "dropped frames: AVI of H.264, three gaps": _avi_of("libx264"),
    "dropped frames: AVI of MPEG-4, three gaps": _avi_of("mpeg4"),
    "dropped frames: AVI, the last five": _avi_end,
    "display: eight matrices of MP4": _matrices("mp4"),
    "display: eight matrices of MOV": _matrices("mov"),
    "display: eight orientations of photographs": _photographs,
    "people: two real ones, two points never seen": _never_seen,
    "people: one and his copy, a point never seen": _never_seen_copy,
}
"""{what it is: whether the answer is right}; each gets an empty folder."""
