"""The report in a real browser, off the disk: all is drawn, nothing is loaded, nothing overflows, no name is run."""

import base64
import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from colmap_inertial.report import write_report
from tests.helpers.report_runs import HOSTILE, write_run

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")

pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no Chromium here (apt-get install chromium chromium-driver)"
)

WIDTHS = {"desktop": (1280, 900, False), "phone": (390, 844, True)}


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium, with its console and its requests kept."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--enable-unsafe-swiftshader",
        "--use-angle=swiftshader",
        "--hide-scrollbars",
    ):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.set_script_timeout(60)
    driver.shown = None
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Reports by kind: everything there, with names that a page must not run; two refused scales; a stopped run."""
    root = tmp_path_factory.mktemp("reports")
    write_run(root / "full", name=HOSTILE, duration_s=8.0)
    write_run(root / "both refused", kind="constant_velocity", duration_s=8.0, models=2)
    (root / "stopped").mkdir()
    stopped = root / "stopped"
    page = {kind: write_report(root / kind) for kind in ("full", "both refused")}
    return page | {"stopped": write_report(stopped, stopped="the video was stabilised", capture="capture.toml")}


@dataclass
class Visit:
    """A page that was opened and has drawn what it has to draw."""

    asked: tuple
    driver: object
    console: list[str]
    requests: list[str]

    def script(self, code: str):
        return self.driver.execute_script(code)


def visit(driver, page: Path, width: str, *, dark: bool = False, wait: bool = True) -> Visit:
    """Opens a page and waits for its plots; the one that is on the screen already is not loaded again."""
    asked = (page, width, dark)
    if driver.shown is not None and driver.shown.asked == asked:
        return driver.shown
    driver.shown = None
    across, down, mobile = WIDTHS[width]
    screen = {"width": across, "height": down, "deviceScaleFactor": 1, "mobile": mobile}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": mobile})
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(page.as_uri())
    until = time.monotonic() + 60
    while wait and not driver.execute_script("return document.documentElement.dataset.plots"):
        assert time.monotonic() < until, "the plots were not drawn within a minute"
        time.sleep(0.05)
    console = [f"{line['level']}: {line['message']}" for line in driver.get_log("browser")]
    events = [json.loads(line["message"])["message"] for line in driver.get_log("performance")]
    sent = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
    driver.shown = Visit(asked=asked, driver=driver, console=console, requests=sent)
    return driver.shown


def drawn(browser, pages, kind, width, *, dark=False) -> Visit:
    """A page of which every plot is drawn, without errors or requests."""
    seen = visit(browser, pages[kind], width, dark=dark)
    assert seen.script("return document.documentElement.dataset.plots") == "drawn"
    assert not [line for line in seen.console if line.startswith("SEVERE")]
    asked = [url for url in seen.requests if not url.startswith(("data:", "blob:"))]
    assert asked == [pages[kind].as_uri()]
    empty = seen.script(
        """return [...document.querySelectorAll('.plot')].filter(div => {
             const cloud = div.querySelector('.gl-container canvas');
             const lines = div.querySelectorAll('.scatterlayer path.js-line, .scatterlayer path.point, .bars path');
             const height = div.getBoundingClientRect().height;
             return height < 150 || (!cloud && lines.length === 0);
           }).map(div => div.dataset.figure)"""
    )
    assert empty == []
    assert seen.script("return document.querySelectorAll('.gl-container canvas').length") == len(
        seen.script("return [...document.querySelectorAll('section[id^=scene] .plot')]")
    )
    least = {"full": 12, "both refused": 10}[kind]
    assert seen.script("return document.querySelectorAll('.plot').length") >= least
    assert seen.script(
        """return [...document.querySelectorAll('img:not(.still)')].every(
             image => image.complete && image.naturalWidth > 0
           )"""
    )
    assert_nothing_overflows(seen, width)
    return seen


# Loading a page takes seconds: tests of one that stands on the screen follow each other.


#: Of the picture of the model on the first screen: where it lies, and how many pixels of its points are drawn.
PICTURE = """
    const done = arguments[arguments.length - 1];
    const still = document.querySelector('#outcome .still'), box = still.getBoundingClientRect(), image = new Image();
    image.src = still.querySelector('image').getAttribute('href');
    image.decode().then(() => {
        const canvas = Object.assign(document.createElement('canvas'), {width: image.width, height: image.height});
        const brush = canvas.getContext('2d');
        brush.drawImage(image, 0, 0);
        const pixels = brush.getImageData(0, 0, image.width, image.height).data;
        let drawn = 0;
        for (let i = 3; i < pixels.length; i += 4) drawn += pixels[i] > 0;
        done([box.top, box.bottom, box.left, box.right, drawn]);
    });
"""


@pytest.mark.parametrize("width", ["phone", "desktop"])
def test_the_first_screen_shows_the_model_beside_what_it_says(browser, pages, width):
    seen = visit(browser, pages["full"], width)
    top, bottom, left, right, points = browser.execute_async_script(PICTURE)
    across, down, _ = WIDTHS[width]
    assert 0 < top < bottom < down and 0 < left < right <= across
    assert right - left > 0.3 * across and points > 1000
    asked = (
        "return [...document.querySelectorAll('.answers dt, .answers h2')].map(e => e.getBoundingClientRect().bottom)"
    )
    said = seen.script(asked)
    assert len(said) == 4 and max(said) < down


def test_names_are_shown_and_not_run(browser, pages):
    seen = visit(browser, pages["full"], "desktop")
    assert seen.script("return document.title").startswith(HOSTILE.rsplit("/", 1)[1])  # a folder's name
    text = seen.script("return document.body.innerText")
    assert "<script>alert" in text
    for leaked in ("DecompressionStream", "use strict", "function(", "undefined", "NaN", "[object"):
        assert leaked not in text
    assert seen.script("return [...document.querySelectorAll('[onerror]')].length") == 0
    assert seen.script("return document.querySelectorAll('img[src=\"x\"]').length") == 0


def assert_nothing_overflows(seen: Visit, width: str) -> None:
    across = WIDTHS[width][0]
    assert seen.script("return document.documentElement.scrollWidth") <= across
    outside = seen.script(
        f"""return [...document.querySelectorAll('main *, header *, footer *')].filter(element =>
             !element.closest('.plot') && element.getBoundingClientRect().right > {across} + 1
           ).map(element => element.outerHTML.slice(0, 80))"""
    )
    assert outside == []


def test_the_cloud_is_really_there_and_can_be_turned(browser, pages):
    seen = visit(browser, pages["full"], "desktop")
    # a WebGL canvas is empty once shown: plotly draws it again for a picture
    picture = """
        const done = arguments[arguments.length - 1];
        const div = document.querySelector('#scene .plot');
        const eye = arguments[0];
        const draw = async () => {
          if (eye) await Plotly.relayout(div, {'scene.camera.eye': eye});
          const url = await Plotly.toImage(div, {format: 'png', width: 300, height: 300});
          const image = new Image();
          image.src = url;
          await image.decode();
          const canvas = document.createElement('canvas');
          canvas.width = canvas.height = 300;
          const context = canvas.getContext('2d');
          context.drawImage(image, 0, 0);
          const pixels = context.getImageData(0, 0, 300, 220).data;
          let drawn = 0, sum = 0;
          for (let i = 0; i < pixels.length; i += 4) {
            if (pixels[i + 3] > 40) { drawn++; sum += i % 997; }
          }
          return [drawn, sum];
        };
        draw().then(done, error => done(String(error)));
    """
    before = seen.driver.execute_async_script(picture, None)
    after = seen.driver.execute_async_script(picture, {"x": -1.2, "y": 0.4, "z": 1.6})
    assert before[0] > 300 and after[0] > 300
    assert before != after


#: Of each plot: whether it is shown, where its still picture lies, and how many shapes that has.
BOXES = """JSON.stringify([...document.querySelectorAll('.plot')].map((plot) => {
    const still = plot.nextElementSibling, box = still.getBoundingClientRect();
    return {
        shown: getComputedStyle(plot).display, left: box.left, right: box.right, height: box.height,
        width: box.width, shapes: still.querySelectorAll('path, rect').length,
    };
}))"""

#: Until eight frames are drawn.
SETTLE = """
    let n = 0;
    const next = () => ++n > 8 ? arguments[0]() : requestAnimationFrame(next);
    next();
"""


def test_it_prints_on_a4_with_still_pictures_and_nothing_cut(browser, pages):
    seen = visit(browser, pages["full"], "desktop")
    paper = {"preferCSSPageSize": True, "printBackground": True}
    printed = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", paper)["data"])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    # A4 without its margins, at 96 dots an inch
    sheet = {"width": 688, "height": 1006, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", sheet)
    try:
        browser.execute_async_script(SETTLE)
        boxes = json.loads(seen.script(f"return {BOXES}"))
        wide = seen.script("return document.documentElement.scrollWidth")
    finally:
        across, down, mobile = WIDTHS["desktop"]
        screen = {"width": across, "height": down, "deviceScaleFactor": 1, "mobile": mobile}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert len(boxes) > 10
    for box in boxes:
        assert box["shown"] == "none" and box["width"] > 300 and box["shapes"] > 3
        assert box["left"] >= 0 and box["right"] <= 689 and box["height"] < 500
    assert wide <= 689
    assert b"/MediaBox [0 0 594" in printed or b"/MediaBox [0 0 595" in printed


def colours(seen: Visit) -> list[str]:
    """Of the page, of a still picture's title, and of a plot's axis."""
    words = "getComputedStyle(document.querySelector('.still .title')).fill"
    colour = f"return getComputedStyle(document.body).backgroundColor + {words}"
    tick = "return getComputedStyle(document.querySelector('section[id^=rotation] .plot .xtick text')).fill"
    return [seen.script(colour), seen.script(tick)]


@pytest.fixture(scope="module")
def bright(browser, pages):
    return colours(visit(browser, pages["full"], "desktop"))


@pytest.mark.parametrize(("kind", "width"), [("full", "desktop"), ("both refused", "phone")])
def test_every_plot_is_drawn_without_errors_or_requests(browser, pages, bright, kind, width):  # the bright page first
    drawn(browser, pages, kind, width, dark=kind != "full")


def test_it_follows_a_dark_screen(browser, pages, bright):
    dark = drawn(browser, pages, "both refused", "phone", dark=True)
    assert all(a != b for a, b in zip(bright, colours(dark), strict=True))
    browser.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": "light"}]}
    )
    browser.shown = None
    until = time.monotonic() + 20
    while colours(dark) != bright:
        assert time.monotonic() < until, "the plots did not follow"
        time.sleep(0.1)


def test_without_waiting_a_page_prints_with_all_of_its_plots(browser, pages):
    """Printed while plotly.js is still at work, and where it never works."""
    browser.shown = None
    source = {"source": "delete window.DecompressionStream"}
    old = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", source)
    try:
        visit(browser, pages["full"], "desktop")
        boxes = json.loads(browser.execute_script(f"return {BOXES}"))
        assert len(boxes) > 10
        for box in boxes:
            assert box["shown"] == "none" and box["width"] > 500 and box["height"] > 150 and box["shapes"] > 3
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", {"identifier": old["identifier"]})
        browser.shown = None


def test_a_run_that_stopped_has_a_page_without_plots(browser, pages):
    seen = visit(browser, pages["stopped"], "phone", wait=False)
    assert not [line for line in seen.console if line.startswith("SEVERE")]
    assert "The video was stabilised" in seen.script("return document.body.innerText")
    assert_nothing_overflows(seen, "phone")


def test_text_tables_and_plots_stand_without_scripts(browser, pages):
    browser.shown = None
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.get(pages["both refused"].as_uri())
        text = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})
        names = " ".join(str(node.get("name", {}).get("value", "")) for node in text["nodes"])
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
    assert "The scale could not be determined" in names
    assert "With JavaScript, the plots can be turned and zoomed" in names
    # the words of the still pictures
    assert "time since the first frame (s)" in names
    assert "config.toml" in names


def test_a_browser_that_cannot_unpack_says_so(browser, pages):
    browser.shown = None
    old = browser.execute_cdp_cmd(
        "Page.addScriptToEvaluateOnNewDocument", {"source": "delete window.DecompressionStream"}
    )
    try:
        seen = visit(browser, pages["both refused"], "desktop")
        assert seen.script("return document.documentElement.dataset.plots") == "none"
        assert "newer browser" in seen.script("return document.getElementById('notice').innerText")
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", {"identifier": old["identifier"]})
