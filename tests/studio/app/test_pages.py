"""The whole way through the pages in a real browser: by clicks, by keys, after a crash, in two windows, on a phone."""

import re
import shutil
import time
from urllib.parse import quote

import pytest
from tests.studio.app.running import running_app

from kinefit import read_motion
from kinefit.readers.landmarks.annotations import read_clicks
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video import Video

pytestmark = pytest.mark.slow
pytest.importorskip("nicegui")
TimedOut = pytest.importorskip("playwright.sync_api").TimeoutError
LONG_MS = 300_000  # that a fit may take on a machine that does other things, too


@pytest.fixture
def session(tmp_path, copy_take):
    """A folder of recordings with one take in it."""
    copy_take(tmp_path / "wave")
    return tmp_path


@pytest.fixture
def open_page(browser):
    """Function that opens an app in a window of its own, after the choice of faces; None leaves it open."""
    contexts = []

    def open_at(address, path="/", faces="Show faces", **viewport):
        context = browser.new_context(viewport={"width": 1300, "height": 900, **viewport}, locale="en-GB")
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(LONG_MS)
        page.goto(f"{address}/")
        page.get_by_text(re.compile("Open a recording|May the faces")).first.wait_for()
        if faces and page.get_by_role("button", name=faces).count():
            page.get_by_role("button", name=faces).click()
            page.get_by_text("Open a recording").wait_for()
        if path != "/":
            page.goto(address + path)
        return page

    yield open_at
    for context in contexts:
        context.close()


def take_path(session):
    return f"/take?path={quote(str(session / 'wave' / 'take.toml'))}"


def go_to(page, share):
    """Move the time line to a share of the motion."""
    slider = page.locator(".q-slider").first
    box = slider.bounding_box()
    slider.click(position={"x": share * box["width"], "y": box["height"] / 2})


def test_from_a_folder_to_a_corrected_motion_without_a_typed_word(session, open_page):
    results = session / "wave" / "take-kinefit"
    with running_app(session) as (_, address):
        page = open_page(address)
        page.get_by_text("wave", exact=True).first.click()
        page.get_by_text(re.compile("[0-9]+ files here that can be opened")).wait_for()
        page.get_by_role("button", name="Open this folder").click()
        page.get_by_text("cam01.mp4").wait_for()
        page.get_by_role("button", name="Compute the motion").click()
        page.get_by_role("button", name="Look at the result").wait_for()
        with page.context.expect_page() as opened:
            page.get_by_role("link", name="Report").click()
        opened.value.get_by_text("Moving figure").first.wait_for()
        opened.value.close()
        before = read_motion(results / "motion.npz")

        page.get_by_role("button", name="Look at the result").click()
        page.get_by_text("Corrections", exact=True).wait_for()
        go_to(page, 0.25)
        page.get_by_role("button", name="From here").click()
        go_to(page, 0.75)
        page.get_by_role("button", name="To here").click()
        page.get_by_text(re.compile(r"From frame 1\d to frame 4\d")).wait_for()
        page.get_by_role("button", name="Do not use cam01").click()
        page.get_by_role("button", name="Keep only this range").click()
        page.get_by_role("button", name="Compute the motion again").click()
        page.get_by_role("button", name="Look at the result").wait_for()
        page.get_by_role("button", name="Look at the result").click()
        page.get_by_role("button", name="bvh").click()
        page.get_by_text(re.compile("Written: .*motion.bvh")).wait_for()
    after, take = read_motion(results / "motion.npz"), read_take(session / "wave" / "take.toml")
    assert len(before) == 60 and len(after) == take.frames[1] - take.frames[0] < 40
    assert after.residuals["cam01"].norms.size == 0 or not (after.residuals["cam01"].weights > 0).any()
    bvh = pytest.importorskip("bvhio").readAsBvh(str(results / "motion.bvh"))
    assert bvh.FrameCount in (len(after), len(after) + 1)  # after a rest pose


def test_a_correction_is_taken_back(session, open_page):
    file = session / "wave" / "take.toml"
    text = file.read_text()
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session))
        page.get_by_role("button", name="Compute the motion").click()
        page.get_by_role("button", name="Look at the result").click()
        page.get_by_text("Corrections", exact=True).wait_for()
        page.get_by_role("button", name="Keep only this range").click()
        page.get_by_text(re.compile("Choose a range first")).nth(1).wait_for()
        assert file.read_text() == text
        page.get_by_role("button", name="From here").click()
        go_to(page, 0.5)
        page.get_by_role("button", name="To here").click()
        page.get_by_role("button", name="Exchange left and right of cam01").click()
        page.get_by_text("The take was changed after this result was computed.").wait_for()
        page.get_by_role("button", name="Take the last correction back").click()
        page.get_by_text("No correction yet.").wait_for()
        assert page.get_by_text("The take was changed").count() == 0
    assert file.read_text() == text


def test_after_a_crash_it_goes_on(session, open_page):
    with running_app(session) as (process, address):
        page = open_page(address, take_path(session))
        page.get_by_role("button", name="Compute the motion").click()
        page.get_by_text("Measuring the person").wait_for()
        process.kill()  # SIGKILL: its command sees the end of its input, and writes what is done
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session))
        page.get_by_role("button", name=re.compile("Go on|Compute the motion|Look at the result")).first.wait_for()
        page.wait_for_timeout(1500)
        if page.get_by_role("button", name="Go on").count():
            page.get_by_role("button", name="Go on").click()
        elif not page.get_by_role("button", name="Look at the result").count():
            page.get_by_role("button", name="Compute the motion").click()
        page.get_by_role("button", name="Look at the result").wait_for()
    assert len(read_motion(session / "wave" / "take-kinefit" / "motion.npz")) == 60


def test_two_windows_show_one_job_and_closing_them_stops_nothing(session, open_page):
    with running_app(session) as (_, address):
        first, second = (open_page(address, take_path(session)) for _ in range(2))
        first.get_by_role("button", name="Compute the motion").click()
        second.get_by_role("button", name="Compute the motion").click()  # the same job
        for page in (first, second):
            page.get_by_role("button", name="Pause").wait_for()
        assert [page.get_by_role("button", name="Pause").count() for page in (first, second)] == [1, 1]
        first.context.close()
        second.context.close()
        motion = session / "wave" / "take-kinefit" / "report.html"
        until = time.monotonic() + LONG_MS / 1000
        while not motion.exists() and time.monotonic() < until:
            time.sleep(0.2)
        assert motion.exists()


def test_nothing_is_wider_than_a_phone(session, open_page):
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session), width=390, height=844)
        page.get_by_role("button", name="Compute the motion").click()
        page.get_by_role("button", name="Look at the result").wait_for()
        widths = [page.evaluate("document.documentElement.scrollWidth")]
        page.get_by_role("button", name="Look at the result").click()
        page.get_by_text("Corrections", exact=True).wait_for()
        widths.append(page.evaluate("document.documentElement.scrollWidth"))
        page.goto(f"{address}/")
        page.get_by_text("Open a recording").wait_for()
        widths.append(page.evaluate("document.documentElement.scrollWidth"))
    assert max(widths) <= 390


def test_by_keys_alone(session, open_page):
    with running_app(session) as (_, address):
        page = open_page(address, faces=None)
        page.get_by_role("button", name="Hide all faces").wait_for()

        def press(said):
            """Go on by Tab to what says so, and press Enter."""
            for _ in range(60):
                page.keyboard.press("Tab")
                if said.lower() in page.evaluate("document.activeElement.innerText || ''").lower():
                    page.keyboard.press("Enter")
                    return
            raise AssertionError(f"{said} is not reached by Tab")

        press("Show faces")
        page.get_by_text("Open a recording").wait_for()
        press("wave")
        page.get_by_text(re.compile("[0-9]+ files here that can be opened")).wait_for()
        press("Open this folder")
        page.get_by_text("cam01.mp4").wait_for()


@pytest.mark.parametrize("what", ["empty", "broken", "gone"])
def test_bad_input_says_what_is_wrong_where_and_what_to_do(what, tmp_path, open_page):
    folder = tmp_path / "recording"
    if what != "gone":
        folder.mkdir()
    if what == "broken":
        (folder / "a.mp4").write_bytes(b"no video" * 100)
    with running_app(tmp_path) as (_, address):
        page = open_page(address, f"/take?path={quote(str(folder))}")
        page.get_by_role("alert").wait_for()
        page.get_by_text(re.compile("Where: .*recording")).wait_for()
        page.get_by_text(re.compile("What to do: .+")).wait_for()
    assert not (folder / "take.toml").exists()


def test_a_take_that_is_moved_while_it_is_open(session, open_page):
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session))
        page.get_by_role("button", name="Compute the motion").wait_for()
        shutil.move(session / "wave", session / "moved")
        page.get_by_text(re.compile("There is no take file any more")).wait_for()


def test_pages_of_recordings_run_apart_and_other_files_are_not_given(tmp_path, open_page):
    (tmp_path / "page.html").write_text("<p>a report</p>")
    (tmp_path / "secret.txt").write_text("x")
    with running_app(tmp_path) as (_, address):
        page = open_page(address)
        answers = {name: page.request.get(f"{address}/file?path={quote(str(tmp_path / name))}")
                   for name in ("page.html", "secret.txt", "gone.html")}  # fmt: skip
        assert [answer.status for answer in answers.values()] == [200, 404, 404]
        policy = answers["page.html"].headers["content-security-policy"]
        assert "sandbox" in policy and "allow-same-origin" not in policy


def test_faces_stay_hidden_until_they_are_found(session, open_page):
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session), faces="Hide all faces")
        page.get_by_role("button", name="Compute the motion").wait_for()
        assert page.get_by_text("Faces are hidden").count() == 1


def choose(page, name, option):
    """Choose from a menu, which a page that is not yet filled closes again."""
    for attempt in range(5):
        page.get_by_role("combobox", name=name).click()
        try:
            return page.get_by_role("option", name=option).click(timeout=20_000)
        except TimedOut:
            assert attempt < 4
            page.keyboard.press("Escape")


def test_a_joint_is_placed_and_the_person_meant_stays(session, open_page):
    file = session / "wave" / "take.toml"
    with running_app(session) as (_, address):
        page = open_page(address, take_path(session))
        choose(page, "Who is meant", "the one who moves most")
        page.get_by_text("The choice is in the take file.").wait_for()
        page.get_by_role("button", name="Compute the motion").click()
        page.get_by_role("button", name="Look at the result").click()
        page.get_by_text("Corrections", exact=True).wait_for()
        page.get_by_role("combobox", name="Joint").fill("r_knee")
        page.get_by_role("option", name="r_knee").click()
        image = page.get_by_role("img", name="cam02").or_(page.locator("[alt=cam02]")).first
        image.scroll_into_view_if_needed()
        box = image.bounding_box()
        image.click(position={"x": box["width"] / 2, "y": box["height"] / 4})
        page.get_by_text("r_knee is placed by hand in camera cam02 at step 0.").wait_for()
    take = read_take(file)
    (clicks,) = read_clicks(take.clicks)
    assert take.person == "moving" and clicks.step == 0
    with Video(take.cameras[1].video) as video:
        expected = video.size[0] / 2, video.size[1] / 4
    assert clicks.points["cam02"]["r_knee"] == pytest.approx(expected, abs=0.02 * max(expected))


def test_a_folder_gets_its_take_file_by_a_click_and_not_by_its_address(session, open_page):
    folder = session / "new"
    folder.mkdir()
    shutil.copy(session / "wave" / "cam01.mp4", folder)
    with running_app(session) as (_, address):
        page = open_page(address, f"/take?path={quote(str(folder))}")
        page.get_by_text(re.compile("There is no take file in .*new yet")).wait_for()
        page.reload()
        page.get_by_role("button", name="Open this folder").wait_for()
        assert not (folder / "take.toml").exists()
        page.get_by_role("button", name="Open this folder").click()
        page.get_by_role("button", name="Compute the motion").wait_for()
        assert read_take(folder).cameras[0].name == "cam01"
