"""The pages of `make docs` as a person sees them: nothing is fetched from other machines, and they fit a phone."""

import subprocess
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import pytest

from docs import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.browser
ROOT = Path(__file__).resolve().parents[2]


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def site(browser: "Browser", tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("latex2mathml", "material", "mkdocstrings"):
        pytest.importorskip(package, reason=f"{package} is missing: run `make docs-setup`")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True)
    return folder


def test_navigation_and_search_from_the_disk(browser: "Browser", site: Path) -> None:
    context = browser.new_context(viewport={"width": 1200, "height": 900})
    page = context.new_page()
    traffic = chromium.watch(page)
    page.goto((site / "index.html").as_uri())
    for link in ("Your own images", "Troubleshooting", "Reliability"):
        page.locator(".md-sidebar--primary").get_by_role("link", name=link).wait_for(state="visible")
    page.fill(".md-search__input", "odometry")
    page.locator(".md-search-result__link", has_text="Odometry").first.click()
    page.wait_for_url("**/*.html?h=odometry*")
    assert not (traffic.outside + traffic.errors)
    context.close()


def test_pages_need_no_other_machine_and_fit_a_phone(browser: "Browser", site: Path) -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        context = browser.new_context(viewport={"width": 390, "height": 800})
        page = context.new_page()
        traffic = chromium.watch(page)
        names = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))
        assert len(names) > 25
        for name in names:
            page.goto(f"http://127.0.0.1:{server.server_port}/{name}")
            assert not (traffic.outside + traffic.errors), name
            # The next page ends what this one still fetches for its search.
            assert all("ERR_ABORTED" in failure for failure in traffic.failed), name
            too_wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
            assert too_wide <= 0, f"{name} is {too_wide} pixels wider than the window"
            cut_off = page.evaluate(
                "[...document.querySelectorAll('.md-content pre > code')]"
                ".filter(code => code.scrollWidth > code.clientWidth).map(code => code.innerText)"
            )
            assert not cut_off, f"{name}: {cut_off}"
            pictures = page.evaluate("[...document.images].map(image => [image.src, image.alt, image.naturalWidth])")
            assert all(alt and width for _, alt, width in pictures), pictures
        page.goto(f"http://127.0.0.1:{server.server_port}/how/localize.html")
        assert page.locator("math").count() == 3
        assert page.locator("math").first.bounding_box()["height"] > 20  # type: ignore[index]
        context.close()
        server.shutdown()
