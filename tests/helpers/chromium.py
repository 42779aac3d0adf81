"""A real headless Chromium, driven over its DevTools protocol: what a page logs and requests, clicks, screenshots."""

import base64
import json
import shutil
import subprocess
import time
from pathlib import Path

import pytest

#: WebGL without a graphics card.
_FLAGS = [
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--remote-debugging-port=0",
]


def chromium_or_skip():
    """Path of the browser; skips the test where there is none."""
    found = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    if found is None:
        pytest.skip("no Chromium here (apt install chromium)")
    return found


class Page:
    """One tab. ``errors`` and ``requests`` grow while :meth:`wait` listens."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 800) -> None:
        size = f"--window-size={width},{height}"
        connect = pytest.importorskip("websockets.sync.client").connect
        command = [chromium_or_skip(), *_FLAGS, size, f"--user-data-dir={profile}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._answers: dict[int, dict] = {}
        self._count = 0
        try:
            self._socket = connect(self._address(profile), max_size=None)
            target = self.call("Target.getTargets")["targetInfos"]
            page = next(t["targetId"] for t in target if t["type"] == "page")
            self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            self.call("Emulation.setDeviceMetricsOverride", **metrics)
        except BaseException:
            self._process.kill()
            raise

    _session: str | None = None

    def _address(self, profile: Path) -> str:
        port_file = profile / "DevToolsActivePort"
        for _ in range(1200):  # a minute: the first start on a busy machine takes long
            if port_file.is_file() and len(lines := port_file.read_text().splitlines()) == 2:
                return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
            time.sleep(0.05)
        raise TimeoutError("Chromium did not start")

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def call(self, method: str, **params):
        """One command of the protocol."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while self._count not in self._answers:
            self._listen(60)
        answer = self._answers.pop(self._count)
        assert "error" not in answer, f"{method}: {answer['error']}"
        return answer["result"]

    def _listen(self, timeout_s: float) -> None:
        event = json.loads(self._socket.recv(timeout=timeout_s))
        if "id" in event:
            self._answers[event["id"]] = event
            return
        method, params = event["method"], event["params"]
        if method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(f"{params['entry']['text']} {params['entry'].get('url', '')}")
        elif method in ("Network.requestWillBeSent", "Network.webSocketCreated"):
            self.requests.append(params["request"]["url"] if "request" in params else params["url"])

    def wait(self, expression: str, timeout_s: float = 60):
        """The value of a JavaScript expression, once it is true."""
        end = time.monotonic() + timeout_s
        while True:
            value = self.evaluate(expression)
            if value:
                return value
            assert time.monotonic() < end, f"{expression} did not become true; errors: {self.errors}"
            time.sleep(0.1)

    def evaluate(self, expression: str):
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def click(self, x: float, y: float) -> None:
        """Click with the mouse."""
        for kind, buttons in (("mouseMoved", 0), ("mousePressed", 1), ("mouseReleased", 0)):
            button = "none" if kind == "mouseMoved" else "left"
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1)
            time.sleep(0.1)

    def middle_of(self, selector: str, text: str = "") -> tuple[float, float]:
        """Where to click for the first visible element of this kind that has this text."""
        chosen = f"e.getBoundingClientRect().width && e.innerText.includes({json.dumps(text)})"
        find = f"[...document.querySelectorAll({json.dumps(selector)})].find(e => {chosen})"
        box = self.wait(
            f"(e => e && (r => [r.x + r.width / 2, r.y + r.height / 2])(e.getBoundingClientRect()))({find})"
        )
        return box[0], box[1]

    def settle(self, frames: int = 8) -> None:
        """Wait for so many frames to be drawn."""
        count = "let n = 0; const next = () => ++n > frames ? done(n) : requestAnimationFrame(next); next()"
        promise = f"new Promise(done => {{ const frames = {frames}; {count} }})"
        self.call("Runtime.evaluate", expression=promise, awaitPromise=True)

    def screenshot(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
