"""Screenshots of a report: desk, phone, dark, without scripts, and on paper.

    python -m scripts.shoot_report OUT/report.html FOLDER

Needs chromium and, for paper, pdftoppm (poppler-utils). Plots are waited for, except where scripts are off.
"""

import base64
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers.chromium import Page

#: Name, width and height (px), whether the screen is dark, and whether scripts run.
_SCREENS = [
    ("first", 1280, 800, False, True),
    ("phone", 390, 844, False, True),
    ("dark", 1280, 800, True, True),
    ("plain", 1280, 800, False, False),
    ("plain_phone", 390, 844, False, False),
]


def shoot(page: Page, report: Path, folder: Path) -> None:
    """Write the pictures."""
    for name, width, height, dark, scripts in _SCREENS:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 640}
        page.call("Emulation.setDeviceMetricsOverride", **metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.call("Emulation.setEmulatedMedia", features=[scheme])
        page.call("Emulation.setScriptExecutionDisabled", value=not scripts)
        page.open(report.resolve().as_uri())
        time.sleep(1.0)
        if scripts:
            page.wait("document.documentElement.dataset.plots")
        for suffix, whole in (("", False), ("_whole", True)):
            shot = page.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole, **_clip(page, whole))
            (folder / f"{name}{suffix}.png").write_bytes(base64.b64decode(shot["data"]))
    page.call("Emulation.setScriptExecutionDisabled", value=False)
    page.open(report.resolve().as_uri())
    time.sleep(2.0)
    printed = page.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)["data"]
    (folder / "print.pdf").write_bytes(base64.b64decode(printed))
    subprocess.run(["pdftoppm", "-r", "60", "-png", folder / "print.pdf", folder / "print"], check=True)


def _clip(page: Page, whole: bool) -> dict:
    size = page.call("Page.getLayoutMetrics")["cssContentSize"]
    return {"clip": {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 0.6}} if whole else {}


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    target = Path(sys.argv[2])
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as profile:
        tab = Page(Path(profile))
        try:
            shoot(tab, Path(sys.argv[1]), target)
        finally:
            tab.close()
