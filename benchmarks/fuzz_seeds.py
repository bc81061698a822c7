"""A small valid file for a reader, made at run time, and what reads it: see `fuzz_readers` for all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from importlib import resources
from pathlib import Path

import av
import cv2
import numpy as np

ASF = """:version 1.10
:units
  mass 1.0
  length 0.5
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 1 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name arm
     direction 2 0 0
     length 3
     axis 0 0 90 XYZ
    dof rx rz
    limits (-90 90)
           (0 inf)
  end
  begin
     id 2
     name hand
     direction 0 1 0
     length 1
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root arm
    arm hand
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n" + "".join(f"{i}\nroot 0 1 0 0 {i} 0\narm {i} 20\n" for i in range(1, 5))
QUALISYS = (
    '<?xml version="1.0"?><calibration><cameras>'
    + "".join(
        f'<camera active="1" serial="s{i}" viewrotation="0"><fov_video bottom="719" left="0" right="1279" top="0"/>'
        '<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" '
        f'x="{i}00" y="200" z="3000"/>'
        '<intrinsic focalLengthU="64000" focalLengthV="64000" centerPointU="41600" centerPointV="23040" '
        'radialDistortion1="-0.1" radialDistortion2="0.2" radialDistortion3="0.3" tangentalDistortion1="0.001" '
        'tangentalDistortion2="0.002" skew="0"/></camera>'
        for i in (1, 9)
    )
    + "</cameras></calibration>"
)
PLY = "ply\nformat ascii 1.0\nelement vertex 400\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@dataclass(frozen=True)
class Seed:
    """What is damaged, and what reads it: `read()` returns, or raises a `KinefitError`."""

    files: tuple[Path, ...]
    read: Callable[[], object]


def finite(thing: object, name: str = "") -> object:
    """A body or a rig, handed through; ValueError where a number of it is none."""
    if isinstance(thing, np.ndarray | float):
        bad = np.asarray(thing).dtype.kind == "f" and np.isnan(thing).any()
        if bad or (name not in _ENDLESS and np.asarray(thing).dtype.kind == "f" and np.isinf(thing).any()):
            raise ValueError(f"a result with {name} of {np.asarray(thing).ravel()[:9]}")
    elif isinstance(thing, dict | tuple | list):
        for key, one in thing.items() if isinstance(thing, dict) else zip([name] * len(thing), thing):
            finite(one, str(key))
    elif is_dataclass(thing):
        for field in fields(thing):
            finite(getattr(thing, field.name), field.name)
    return thing


_ENDLESS = ("lower", "upper", "spread", "radii")  # of a bulge, too


def _motion():
    from kinefit.simulation import cut, squat_and_wave

    return cut(squat_and_wave(), 0, 4)


def _rig():
    from kinefit.simulation import studio_rig

    return studio_rig(_motion(), cameras=2, size=(64, 48))


def _take(folder: Path) -> Seed:
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations

    calibration_of(folder)
    text = '[take]\nname = "walk"\nrate = 30.0\nup = "z"\nheight = 1.75\nframes = [0, 4]\n[calibration]\n'
    text += 'file = "calibration.toml"\nunit = "m"\n'
    for camera in _rig().names:
        np.save(folder / f"{camera}.npy", np.full((4, 33, 3), 0.9))
        text += f'[[camera]]\nname = "{camera}"\nsize = [64, 48]\ntime_offset = 0.0\n'
        text += f'[[keypoints]]\ncamera = "{camera}"\nfile = "{camera}.npy"\nformat = "mediapipe"\nsigma = 4.0\n'
    (folder / "take.toml").write_text(text)
    return Seed((folder / "take.toml",), lambda: load_observations(read_take(folder / "take.toml")))


def calibration_of(folder: Path) -> Seed:
    """The calibration of two cameras, cam01 and cam02."""
    from kinefit.readers.calibration.read import read_calibration, write_calibration

    write_calibration(_rig(), folder / "calibration.toml")
    return _calibrated(folder / "calibration.toml", read_calibration)


def _calibrated(path: Path, read: Callable) -> Seed:
    return Seed((path,), lambda: finite(read(path)))


def _opencv(ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.readers.calibration.read import read_calibration

        path = folder / f"calibration{ending}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for camera in _rig():
            storage.startWriteStruct(camera.name, cv2.FileNode_MAP)
            storage.write("camera_matrix", camera.matrix)
            storage.write("distortion_coefficients", np.zeros(5))
            storage.write("rotation", camera.T_camera_world[:3, :3])
            storage.write("translation", camera.T_camera_world[:3, 3])
            storage.write("image_width", 64)
            storage.write("image_height", 48)
            storage.endWriteStruct()
        storage.release()
        return _calibrated(path, read_calibration)

    return make


def _qualisys(folder: Path) -> Seed:
    from kinefit.readers.calibration.read import read_calibration

    (folder / "a.qca.txt").write_text(QUALISYS)
    return _calibrated(folder / "a.qca.txt", read_calibration)


def _colmap(folder: Path) -> Seed:
    from kinefit.readers.calibration.read import read_calibration

    (folder / "cameras.txt").write_text("1 OPENCV 64 48 50 50 32 24 0.1 0 0 0\n2 PINHOLE 64 48 50 50 32 24\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 3 1 a.png\n\n2 0.7 0 0.7 0 0 0 3 2 b.png\n\n")
    files = folder / "cameras.txt", folder / "images.txt"
    return Seed(files, lambda: finite(read_calibration(folder)))


def _openpose(folder: Path) -> Seed:
    from kinefit.readers.landmarks.keypoints import read_openpose

    (folder / "json").mkdir()
    for i in range(3):
        people = [{"pose_keypoints_2d": [v if v % 3 < 2 else 0.9 for v in map(float, range(75))]}]
        (folder / "json" / f"a_{i:04d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": people}))
    files = tuple(sorted((folder / "json").iterdir()))
    return Seed(files, lambda: read_openpose(folder / "json", camera="a", rate=30.0))


def _mediapipe(folder: Path) -> Seed:
    from kinefit.readers.landmarks.keypoints import read_mediapipe

    np.save(folder / "a.npy", np.random.default_rng(0).random((4, 33, 3)) * (640, 480, 1))
    return Seed((folder / "a.npy",), lambda: read_mediapipe(folder / "a.npy", camera="a", rate=30.0))


def _caliscope(folder: Path) -> Seed:
    from kinefit.readers.landmarks.keypoints import read_caliscope_csv

    lines = ["sync_index,port,frame_time,point_id,img_loc_x,img_loc_y"]
    cells = [(i, p, k) for i in range(4) for p in (0, 1) for k in range(0, 33, 4)]
    lines += [f"{i},{p},{i / 30:.3f},{k},{10 * k}.5,{20 + i}.25" for i, p, k in cells]
    (folder / "xy.csv").write_text("\n".join(lines) + "\n")
    return Seed((folder / "xy.csv",), lambda: read_caliscope_csv(folder / "xy.csv"))


def _detections(folder: Path) -> Seed:
    from kinefit.exporters.motion_file import write_detections
    from kinefit.observations import Detections
    from kinefit.readers.landmarks.detections import detections_key, read_detections

    points = np.random.default_rng(0).random((3, 2, 33, 2)).astype(np.float32)
    runs, starts = np.tile([5, 10, 33], 6), np.arange(0, 19, 3)
    found = Detections("a", 30.0, (8, 6), points, np.ones((3, 2, 33)), runs, starts)
    write_detections(found, folder / "a.npz", key="k")

    def read() -> object:
        detections_key(folder / "a.npz")
        seen = read_detections(folder / "a.npz")
        return [seen.mask(i, p) for i in range(len(seen)) for p in range(seen.points.shape[1])], seen.keypoints()

    return Seed((folder / "a.npz",), read)


def _markers(ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.exporters import write_markers
        from kinefit.observations import Markers
        from kinefit.readers.markers import read_markers

        positions = np.random.default_rng(0).random((4, 3, 3)) + 1.0
        write_markers(Markers(("a", "b", "c"), 100.0, positions, up="z"), folder / f"a{ending}")
        return Seed((folder / f"a{ending}",), lambda: read_markers(folder / f"a{ending}"))

    return make


def _motion_file(folder: Path) -> Seed:
    from kinefit.exporters import write_motion
    from kinefit.readers.motion import read_motion

    write_motion(_motion(), folder / "motion.npz")
    return Seed((folder / "motion.npz",), lambda: read_motion(folder / "motion.npz"))


def _bvh(folder: Path) -> Seed:
    from kinefit.exporters import write_bvh
    from kinefit.readers.skeletons.bvh import read_bvh

    write_bvh(_motion(), folder / "a.bvh")
    return Seed((folder / "a.bvh",), lambda: read_bvh(folder / "a.bvh"))


def _amc(folder: Path) -> Seed:
    from kinefit.readers.skeletons.acclaim import read_amc

    (folder / "a.asf").write_text(ASF)
    (folder / "a.amc").write_text(AMC)
    files = folder / "a.asf", folder / "a.amc"
    return Seed(files, lambda: read_amc(*files))


def _static_points(folder: Path) -> Seed:
    from kinefit.readers.landmarks.annotations import read_static_points

    (folder / "points.toml").write_text("[beam]\na = [1.5, 2.0]\nb = [3.0, 4.0]\n[post]\na = [5, 6]\nb = [7, 8]\n")
    return Seed((folder / "points.toml",), lambda: read_static_points(folder / "points.toml", ("a", "b")))


def _lines(ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.sensors.kinds.lines import read_lines

        keys = ("frame", "line", "u1", "v1", "u2", "v2")
        rows = [(i, name, 1.5, 2, 30, 4) for i in range(3) for name in ("hips", "back")]
        path = folder / f"lines{ending}"
        table = "\n".join(",".join(map(str, row)) for row in (keys, *rows))
        path.write_text(table if ending == ".csv" else json.dumps([dict(zip(keys, row)) for row in rows]))
        return Seed((path,), lambda: read_lines(path, ("hips", "back")))

    return make


def depth_counts() -> np.ndarray:
    """Three depth images (3, 48, 64) [mm]."""
    v, u = np.mgrid[0:48, 0:64]
    return np.stack([(1500 + 3 * u + 2 * v + i).astype(np.uint16) for i in range(3)])


def _read_all(path: Path, **options: object) -> Callable[[], object]:
    def read() -> object:
        from kinefit.readers.depth.recordings import read_depth

        video = read_depth(path, **options)  # type: ignore[arg-type]
        return [video.frame(i) for i in range(min(len(video), 3))]

    return read


def _depth(ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        (folder / "depth").mkdir()
        for i, counts in enumerate(depth_counts()):
            file = folder / "depth" / f"d{i}{ending}"
            if ending == ".raw":
                counts.tofile(file)
            else:
                cv2.imwrite(str(file), counts)
        options = {"size": (64, 48)} if ending == ".raw" else {}
        return Seed(tuple(sorted((folder / "depth").iterdir())), _read_all(folder / "depth", rate=30.0, **options))

    return make


def _depth_archive(folder: Path) -> Seed:
    counts = depth_counts()
    np.savez_compressed(folder / "a.npz", depth=counts, times=np.arange(3) / 30, unit=0.001, rate=30.0)
    return Seed((folder / "a.npz",), _read_all(folder / "a.npz"))


def _depth_track(folder: Path) -> Seed:
    with av.open(str(folder / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray16le"
        for counts in depth_counts():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(counts, format="gray16le")))
        container.mux(stream.encode())
    return Seed((folder / "a.mkv",), _read_all(folder / "a.mkv"))


def _points() -> np.ndarray:
    v, u = np.mgrid[0:20, 0:20]
    z = 1.5 + 0.002 * u.ravel()
    return np.stack([(u.ravel() - 9.5) / 20 * z, (v.ravel() - 9.5) / 20 * z, z], 1).astype(np.float32)


def _clouds(kind: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.readers.depth.clouds import camera_of, depth_of, in_sensor, read_cloud

        points, path = _points(), folder / ("a.ply" if "ply" in kind else "a.pcd")
        text = "\n".join(" ".join(f"{v:.5f}" for v in row) for row in points) + "\n"
        head = (
            "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 20\nHEIGHT 20\n"
            "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 400\nDATA "
        )
        binary = PLY.replace("ascii", "binary_little_endian").encode() + points.tobytes()
        packed = b"".join(bytes([31]) + part for part in np.split(np.frombuffer(points.T.tobytes(), np.uint8), 150)
                          for part in [part.tobytes()])  # fmt: skip
        sizes = np.array([len(packed), points.nbytes], "<u4").tobytes()
        path.write_bytes({
            "ply": (PLY + text).encode(), "binary ply": binary, "pcd": (head + "ascii\n" + text).encode(),
            "binary pcd": (head + "binary\n").encode() + points.tobytes(),
            "packed pcd": (head + "binary_compressed\n").encode() + sizes + packed,
        }[kind])  # fmt: skip

        def read() -> object:
            cloud = read_cloud(path)
            if cloud.shape is not None:
                camera_of(cloud, "a")
                depth_of(cloud)
            return in_sensor(cloud)

        return Seed((path,), read)

    return make


def _video(codec: str, ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.readers.videos.video import Video

        path = folder / f"a{ending}"
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for i in range(5):
                picture = np.full((48, 64, 3), 40 * i, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())

        def read() -> object:
            with Video(path) as video:
                return [video.read(i) for i in range(min(len(video), 5))]

        return Seed((path,), read)

    return make


def _images(ending: str) -> Callable[[Path], Seed]:
    def make(folder: Path) -> Seed:
        from kinefit.readers.videos.video import Video

        (folder / "cam").mkdir()
        for i in range(3):
            cv2.imwrite(str(folder / "cam" / f"{i}{ending}"), np.full((48, 64, 3), 60 * i, np.uint8))

        def read() -> object:
            with Video(folder / "cam", rate=30.0) as video:
                return [video.read(i) for i in range(3)]

        return Seed(tuple(sorted((folder / "cam").iterdir())), read)

    return make


def _masks(folder: Path) -> Seed:
    from kinefit.sensors.kinds.silhouettes import read_silhouettes

    (folder / "masks").mkdir()
    for i in range(2):
        mask = np.zeros((48, 64), np.uint8)
        mask[10:30] = 255 * i
        cv2.imwrite(str(folder / "masks" / f"{i}.png"), mask)

    def read() -> object:
        video = read_silhouettes(folder / "masks", camera="a", rate=30.0, size=(64, 48))
        return [video.frame(i) for i in range(2)]

    return Seed(tuple(sorted((folder / "masks").iterdir())), read)


def body_of(name: str) -> Callable[[Path], Seed]:
    """A body of the catalogue as a file."""
    def make(folder: Path) -> Seed:
        from kinefit.bodies import load_body

        text = (resources.files("kinefit.bodies.toml") / "catalogue" / f"{name}.toml").read_text("utf-8")
        (folder / "body.toml").write_text(text)
        return Seed((folder / "body.toml",), lambda: finite(load_body(folder / "body.toml")))

    return make


def _saved_body(folder: Path) -> Seed:
    from kinefit.bodies import load_body
    from kinefit.bodies.serial import save_body

    save_body(load_body("humanoid_morphing"), folder / "body.npz")
    return Seed((folder / "body.npz",), lambda: finite(load_body(folder / "body.npz")))


def _mesh_body(folder: Path) -> Seed:
    from kinefit.bodies import load_body

    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "a.obj").write_text(corners)
    body = '[body]\nname = "thing"\n[[segment]]\nname = "thing"\nsurface = { mesh = "a.obj" }\n'
    body += 'joint = { name = "ground", type = "free" }\n'
    (folder / "body.toml").write_text(body)
    return Seed((folder / "a.obj", folder / "body.toml"), lambda: finite(load_body(folder / "body.toml")))


def _marker_set(folder: Path) -> Seed:
    from kinefit.bodies.marker_sets import load_marker_set

    source = resources.files("kinefit.bodies") / "marker_sets"
    text = sorted((e for e in source.iterdir() if e.name.endswith(".toml")), key=lambda e: e.name)[0].read_text("utf-8")
    (folder / "set.toml").write_text(text)
    return Seed((folder / "set.toml",), lambda: load_marker_set(folder / "set.toml"))


def _subject(folder: Path) -> Seed:
    from kinefit.bodies.marker_sets import load_marker_set
    from kinefit.markers.model.from_frame import model_from_frame
    from kinefit.markers.model.model import load_model, save_model

    markers = load_marker_set("cmu_41")
    save_model(model_from_frame(markers.places, markers.labels, markers), folder / "anna.json")
    return Seed((folder / "anna.json",), lambda: load_model(folder / "anna.json"))


def _folder(folder: Path) -> Seed:
    from kinefit.readers.guess.folder import guess_take

    shutil.rmtree(folder)
    folder.mkdir()
    files = []
    for make in (calibration_of, _mediapipe, _caliscope, _openpose, _markers(".trc")):
        files += make(folder).files
    return Seed(tuple(files), lambda: guess_take(folder))


FIRST: dict[str, Callable[[Path], Seed]] = {
    "take": _take, "calibration toml": calibration_of, "calibration yaml": _opencv(".yml"),
    "calibration xml": _opencv(".xml"), "calibration json": _opencv(".json"), "qualisys": _qualisys, "colmap": _colmap,
    "openpose": _openpose, "mediapipe": _mediapipe, "caliscope": _caliscope, "detections": _detections,
    "c3d": _markers(".c3d"), "trc": _markers(".trc"), "motion": _motion_file, "bvh": _bvh, "amc": _amc,
    "static points": _static_points, "lines csv": _lines(".csv"), "lines json": _lines(".json"),
    "depth png": _depth(".png"), "depth tiff": _depth(".tiff"), "depth raw": _depth(".raw"),
    "depth npz": _depth_archive, "depth mkv": _depth_track, "ply": _clouds("ply"), "binary ply": _clouds("binary ply"),
    "pcd": _clouds("pcd"),
    "binary pcd": _clouds("binary pcd"), "packed pcd": _clouds("packed pcd"), "video mp4": _video("mpeg4", ".mp4"),
    "video avi": _video("mpeg4", ".avi"), "video webm": _video("libvpx", ".webm"), "images png": _images(".png"),
    "images jpg": _images(".jpg"), "masks": _masks, "body toml": body_of("humanoid_morphing"),
    "arm toml": body_of("arm"),
    "body npz": _saved_body, "body mesh": _mesh_body, "marker set": _marker_set, "subject": _subject, "init": _folder,
}  # fmt: skip
"""{reader: maker of its seed}."""
