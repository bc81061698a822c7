"""Fetching of pinned packages, with a pip that hands out made-up wheels; and once the true one."""

import hashlib
import io
import sys
import tarfile
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinefit.errors import AssetError, FileError
from kinefit.geometry.lines import triangulate
from kinefit.readers import assets
from kinefit.readers.assets import clients
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations

FILES = {"thing/video.mp4": b"moving pictures", "thing-1.dist-info/LICENSE": b"do as you like"}
KEPT = {"thing/video.mp4": "videos/cam01.mp4", "thing-1.dist-info/LICENSE": "LICENSE"}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("KINEFIT_CACHE", str(folder))
    return folder


@pytest.fixture
def package(tmp_path):
    """A package, its wheel in tmp_path/index."""
    wheel = tmp_path / "index" / "thing-1-py3-none-any.whl"
    wheel.parent.mkdir()
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in FILES.items():
            archive.writestr(name, content)
        archive.writestr("thing/large.bin", bytes(1000))
    content = wheel.read_bytes()
    members = {name: (KEPT[name], hashlib.sha256(FILES[name]).hexdigest()) for name in FILES}
    return assets.Package("thing", "1", hashlib.sha256(content).hexdigest(), len(content), members)


@pytest.fixture
def pip(tmp_path, monkeypatch, package):
    """A pip that copies the wheel from tmp_path/index and writes down how it was called."""
    script = tmp_path / "pip.py"
    calls = tmp_path / "calls.txt"
    script.write_text(
        "import pathlib, shutil, sys\n"
        f"open({str(calls)!r}, 'a').write(' '.join(sys.argv[1:]) + chr(10))\n"
        f"wheels = list(pathlib.Path({str(tmp_path / 'index')!r}).glob('*.whl'))\n"
        "dest = next(a.split('=', 1)[1] for a in sys.argv if a.startswith('--dest='))\n"
        "[shutil.copy(w, dest) for w in wheels] or sys.exit('ERROR: No matching distribution found for thing==1')\n"
    )
    monkeypatch.setattr(clients, "pip", lambda: [sys.executable, str(script)])
    return calls


def leftovers(cache):
    return [path.name for path in (cache / "assets").iterdir()] if (cache / "assets").exists() else []


def test_fetches_only_the_members_and_only_once(cache, package, pip):
    seen = []
    folder = assets.fetch(package, lambda done, total: seen.append((done, total)))
    files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert files == {KEPT[name]: content for name, content in FILES.items()}
    assert seen[-1] == (package.size, package.size) and seen == sorted(seen)
    assert leftovers(cache) == ["thing-1"]
    assert assets.fetch(package) == folder
    calls = pip.read_text().splitlines()
    assert len(calls) == 1
    assert {"--no-deps", "--only-binary=:all:", "--platform=any", "thing==1"} <= set(calls[0].split())


@pytest.mark.parametrize("damage", ["change", "delete"])
def test_fetches_again_what_was_damaged(cache, package, pip, damage):
    video = assets.fetch(package) / "videos" / "cam01.mp4"
    video.write_bytes(b"other pictures") if damage == "change" else video.unlink()
    assets.fetch(package)
    assert video.read_bytes() == FILES["thing/video.mp4"]
    assert len(pip.read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sha256": "0" * 64}, r"thing-1-py3-none-any\.whl.*SHA-256"),
        ({"members": {"thing/absent": ("absent", "0" * 64)}}, "does not hold.*thing/absent"),
        ({"members": {"thing/video.mp4": ("video.mp4", "0" * 64)}}, "other files than expected"),
    ],
)
def test_refuses_another_package_and_keeps_nothing(cache, package, pip, change, message):
    with pytest.raises(AssetError, match=message):
        assets.fetch(replace(package, **change))
    assert leftovers(cache) == []


def test_says_why_pip_failed(cache, package, pip, tmp_path):
    next((tmp_path / "index").iterdir()).unlink()
    with pytest.raises(AssetError, match=r"thing 1: ERROR: No matching distribution.*PIP_FIND_LINKS"):
        assets.fetch(package)
    assert leftovers(cache) == []


def test_stops_pip_and_cleans_up_when_interrupted(cache, package, monkeypatch):
    monkeypatch.setattr(clients, "pip", lambda: [sys.executable, "-c", "import time; time.sleep(600)"])

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        assets.fetch(package, interrupt)
    assert leftovers(cache) == []


def test_says_that_pip_is_absent(cache, package, monkeypatch):
    monkeypatch.setattr(clients.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(AssetError, match="pip.*not installed.*ensurepip"):
        assets.fetch(package)
    assert leftovers(cache) == []


def test_says_that_the_cache_cannot_be_written(tmp_path, package, pip, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("KINEFIT_CACHE", str(tmp_path / "file"))
    with pytest.raises(AssetError, match="KINEFIT_CACHE"):
        assets.fetch(package)


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """A stand-in for the sample recording: the right names, no pictures."""
    folder = tmp_path / "recording"
    (folder / "videos").mkdir(parents=True)
    for camera in assets.CAMERAS:
        (folder / "videos" / f"{camera}.mp4").write_bytes(camera.encode())
    monkeypatch.setattr(assets, "sample_recording", lambda progress=None: folder)
    return folder


def test_sample_take_holds_all_that_it_names(tmp_path, recording):
    take = assets.write_sample_take(tmp_path / "new" / "take")
    folder = take.parent
    with take.open("rb") as file:
        tomllib.load(file)
    text = take.read_text("utf-8")
    for camera in assets.CAMERAS:
        assert f"{camera}.mp4" in text and (folder / f"{camera}.mp4").read_bytes() == camera.encode()
        assert f"mediapipe_{camera}.npy" in text
        assert np.load(folder / f"mediapipe_{camera}.npy").shape == (100, 33, 3)
    assert "Calib_refined_static.toml" in text
    with (folder / "Calib_refined_static.toml").open("rb") as file:
        assert set(assets.CAMERAS) < set(tomllib.load(file))
    assert "perfanalytics" in (folder / "NOTICE").read_text("utf-8")
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_sample_take_can_be_written_over_itself(tmp_path, recording):
    first = assets.write_sample_take(tmp_path)
    first.write_text("spoilt")
    assert assets.write_sample_take(tmp_path).read_text("utf-8").startswith("#")


def test_sample_take_says_that_a_folder_cannot_be_written(tmp_path, recording):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError, match="file"):
        assets.write_sample_take(tmp_path / "file")


def test_shipped_landmarks_are_those_of_the_recording(tmp_path, recording, data_dir):
    shared = data_dir("video_balancing_4cam")
    folder = assets.write_sample_take(tmp_path).parent
    for camera in assets.CAMERAS:
        shipped, original = (np.load(path) for path in (
            folder / f"mediapipe_{camera}.npy", shared / f"mediapipe_landmarks_{camera}.npy"))
        np.testing.assert_allclose(shipped, original, atol=2e-4)  # float32 of up to 1920 px
    name = "Calib_refined_static.toml"
    assert (folder / name).read_bytes() == (shared / name).read_bytes()


@pytest.mark.network
def test_true_package():
    try:
        folder = assets.sample_recording()
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise
    assert "BSD 3-Clause" in (folder / "LICENSE").read_text("utf-8")
    assert {path.name for path in (folder / "videos").iterdir()} == {f"{camera}.mp4" for camera in assets.CAMERAS}


@pytest.mark.network
def test_true_sample_take_agrees_with_its_calibration(tmp_path):
    """Landmarks of the letterboxed videos, brought into the calibration's image, meet in points above the floor."""
    try:
        take = read_take(assets.write_sample_take(tmp_path))
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise
    seen = load_observations(take)
    assert seen.rate == 60 and seen.frames == (0, 100) and take.up == "z"
    assert [keypoints.camera for keypoints in seen.keypoints] == list(assets.CAMERAS)
    rig = seen.rig.select(("cam01", "cam03", "cam04"))  # cam02 swaps left and right at times
    pixels = np.stack([seen.keypoints[index].points[:, 0] for index in (0, 2, 3)], axis=2)  # (F, K, 3, 2)
    x_world = triangulate(rig, pixels.reshape(-1, 3, 2)).reshape(*pixels.shape[:2], 3)
    error = np.median([np.linalg.norm(c.project(x_world) - pixels[:, :, i], axis=-1) for i, c in enumerate(rig)])
    assert error < 12  # [px]
    names = seen.keypoints[0].names
    head, heel = (np.median(x_world[:, names.index(name), 2]) for name in ("nose", "left_heel"))
    assert 1.2 < head - heel < 1.6 and 0 < heel < 0.4  # [m], z is up


@pytest.fixture
def npm(tmp_path, monkeypatch):
    """An npm that packs what it is asked for into the folder that it is told; the package that it packs."""
    archive = tmp_path / "thing-1.tgz"
    with tarfile.open(archive, "w:gz") as packed:
        for name, content in FILES.items():
            info = tarfile.TarInfo(f"package/{name}")
            info.size = len(content)
            packed.addfile(info, io.BytesIO(content))
    script = tmp_path / "npm.py"
    script.write_text(
        "import shutil, sys\n"
        "dest = next(a.split('=', 1)[1] for a in sys.argv if a.startswith('--pack-destination='))\n"
        f"shutil.copy({str(archive)!r}, dest) if '@of/thing@1' in sys.argv else sys.exit('npm error 404 Not Found')\n"
    )
    monkeypatch.setattr(clients, "npm", lambda partial: [sys.executable, str(script)])
    content = archive.read_bytes()
    members = {f"package/{name}": (KEPT[name], hashlib.sha256(FILES[name]).hexdigest()) for name in FILES}
    return assets.Package("@of/thing", "1", hashlib.sha256(content).hexdigest(), len(content), members, index="npm")


def test_a_package_of_npm_is_unpacked_likewise(cache, npm):
    folder = assets.fetch(npm)
    assert folder.name == "of-thing-1" and (folder / "videos" / "cam01.mp4").read_bytes() == b"moving pictures"
    assert leftovers(cache) == ["of-thing-1"]


def test_says_why_npm_failed(cache, npm):
    with pytest.raises(AssetError, match=r"npm could not fetch @of/thing 2: npm error 404.*registry"):
        assets.fetch(replace(npm, version="2"))
    with pytest.raises(AssetError, match=r"does not hold.*absent"):
        assets.fetch(replace(npm, members={"package/absent": ("absent", "0" * 64)}))
    assert leftovers(cache) == []


def test_without_npm_pip_fetches_one_and_says_where_it_cannot(monkeypatch, tmp_path):
    script = tmp_path / "pip.py"
    script.write_text(
        "import pathlib, sys\n"
        "target = pathlib.Path(next(a.split('=', 1)[1] for a in sys.argv if a.startswith('--target=')))\n"
        "for name in ('bin/node', 'lib/npm/bin/npm-cli.js'):\n"
        "    (target / name).parent.mkdir(parents=True)\n"
        "    (target / name).write_text('')\n"
    )
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(clients, "pip", lambda: [sys.executable, str(script)])
    (tmp_path / "tmp").mkdir()
    assert [Path(word).name for word in clients.npm(tmp_path / "tmp")] == ["node", "npm-cli.js"]
    script.write_text("import sys; sys.exit('ERROR: No matching distribution found')")
    (tmp_path / "more" / "tmp").mkdir(parents=True)
    with pytest.raises(AssetError, match=r"npm.*not installed.*nodejs.*No matching distribution.*Install Node"):
        clients.npm(tmp_path / "more" / "tmp")
