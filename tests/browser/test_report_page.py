"""report.html as a person sees it: on a phone and on a desk, in light and in dark, with no network."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from docs import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.browser
PHONE, DESK = (360, 740), (1200, 900)


@pytest.mark.parametrize(("size", "scheme"), [(PHONE, "light"), (DESK, "light"), (DESK, "dark")])
def test_report_opens_without_errors_and_fits_the_window(
    browser: "Browser", finished_run: Path, tmp_path: Path, size: tuple[int, int], scheme: str
) -> None:
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
    page = context.new_page()
    traffic = chromium.watch(page)
    page.goto((finished_run / "report.html").as_uri())
    assert traffic == chromium.Traffic()
    pictures = page.evaluate("[...document.images].map(image => [image.alt, image.complete && image.naturalWidth])")
    assert len(pictures) >= 5
    assert all(alt and width for alt, width in pictures), pictures
    too_wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
    assert too_wide <= 0, f"the page is {too_wide} pixels wider than the window"
    page.screenshot(path=tmp_path / "report.png", full_page=True)
    page.evaluate("document.querySelectorAll('details').forEach(details => details.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth - window.innerWidth") <= 0, "with all details open"
    count, share = chromium.colors((tmp_path / "report.png").read_bytes())
    assert count > 50, "a page without pictures or shading"
    assert 0.05 < share < 0.95
    context.close()


def test_report_answers_in_the_first_screen(browser: "Browser", finished_run: Path) -> None:
    # No JavaScript is needed.
    context = browser.new_context(viewport={"width": DESK[0], "height": DESK[1]}, java_script_enabled=False)
    page = context.new_page()
    page.goto((finished_run / "report.html").as_uri())
    for text in ("small", "done", "mean recall at 1°", "95 % interval", "queries in 9 pairs", "good reference"):
        box = page.get_by_text(text).first.bounding_box()
        assert box is not None, text
        assert box["y"] + box["height"] <= DESK[1], text
    context.close()


def test_a_picture_enlarges_without_a_script(browser: "Browser", finished_run: Path) -> None:
    context = browser.new_context(viewport={"width": PHONE[0], "height": PHONE[1]}, java_script_enabled=False)
    page = context.new_page()
    page.goto((finished_run / "report.html").as_uri())
    picture = page.locator(".zoom img").first
    widths = []
    for _ in range(3):
        box = picture.bounding_box()
        assert box is not None
        widths.append(box["width"])
        picture.click(position={"x": 10, "y": 10})
    assert widths[0] <= PHONE[0] < widths[1], "the picture itself"
    assert widths[2] == widths[0], "and back"
    context.close()


def test_links_of_the_report_lead_to_files(browser: "Browser", finished_run: Path) -> None:
    page = browser.new_page()
    page.goto((finished_run / "report.html").as_uri())
    links = page.evaluate("[...document.querySelectorAll('a[href]')].map(link => link.href)")
    files = [link.removeprefix("file://") for link in links if "#" not in link]
    assert {Path(file).suffix for file in files} >= {".rrd", ".txt", ".csv", ".jsonl", ".ipynb", ".json"}
    assert not [file for file in files if not Path(file).is_file()]
    for anchor in (link.rpartition("#")[2] for link in links if "#" in link):
        assert page.locator(f"#{anchor}").count() == 1
    page.close()
