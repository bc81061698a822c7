"""Pages of recordings at addresses of their own."""

import urllib.error
import urllib.request

import pytest

from kinefit.studio.app.review import FilePages


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "session"
    (folder / "a").mkdir(parents=True)
    for file in (folder / "a" / "report.html", folder / "b.html", folder / "notes.txt", tmp_path / "secret.html"):
        file.write_text(file.name)
    return folder


@pytest.fixture
def pages(folder):
    pages = FilePages(folder)
    yield pages
    pages.close()


def got(address):
    with urllib.request.urlopen(address, timeout=10) as answer:
        return answer.read().decode(), answer.headers


def test_each_page_has_an_address_and_a_policy_of_its_own(pages, folder):
    first, second = pages.address(folder / "a" / "report.html"), pages.address(folder / "b.html")
    assert first == pages.address(folder / "a" / ".." / "a" / "report.html") and first != second
    text, headers = got(first)
    policy = headers["Content-Security-Policy"]
    assert text == "report.html" and policy.startswith("default-src 'none'") and "connect-src" not in policy
    assert "sandbox allow-scripts" in policy and "allow-same-origin" not in policy and "allow-popups" not in policy
    assert headers["Referrer-Policy"] == "same-origin" and headers["X-Content-Type-Options"] == "nosniff"
    for address in (second[:-1], second.rpartition("/")[0], f"{second}/"):
        with pytest.raises(urllib.error.HTTPError, match="404|403"):
            got(address)


def test_links_are_followed_and_refused_outside(pages, folder, tmp_path):
    (folder / "out.html").symlink_to(tmp_path / "secret.html")
    (folder / "far").symlink_to(tmp_path)
    (folder / "in.html").symlink_to(folder / "b.html")
    (folder / "loop.html").symlink_to(folder / "loop.html")
    (folder / "text.html").symlink_to(folder / "notes.txt")
    refused = ("out.html", "far/secret.html", "../secret.html", "loop.html", "text.html", "notes.txt", "gone.html", "a")
    assert [pages.address(folder / name) for name in refused] == [None] * len(refused)
    assert got(pages.address(folder / "in.html"))[0] == "b.html"
    pages.folders.add(tmp_path)
    assert got(pages.address(folder / "out.html"))[0] == "secret.html"


def test_a_page_that_becomes_a_link_is_served_no_more(pages, folder, tmp_path):
    address = pages.address(folder / "b.html")
    (folder / "b.html").unlink()
    (folder / "b.html").symlink_to(tmp_path / "secret.html")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        got(address)
