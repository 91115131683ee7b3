"""Debian's headless Chromium, fetched and unpacked without installing it, and driven over its own protocol."""

import base64
import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import connect

sys.path.append(str(Path(__file__).parents[1] / "fetched"))
import debian

PACKAGE = "chromium-headless-shell"
PLACE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pkxyz" / "chromium"


def fetched() -> Path:
    """The browser, from the system, or else unpacked below the user's cache from Debian's packages.

    Raises ``OSError`` where neither can be had.
    """
    system = shutil.which(PACKAGE) or shutil.which("chromium")
    if system is not None:
        return Path(system)
    unpacked = PLACE / "root/usr/lib/chromium" / PACKAGE
    if not unpacked.is_file() and (why_not := debian.fetched([PACKAGE], PLACE / "root", with_dependencies=True)):
        raise OSError(f"no Chromium: {why_not}")
    return unpacked


def _libraries(root: Path, binary: Path) -> list[Path]:
    system = root / "usr/lib/x86_64-linux-gnu"
    return [system, system / "pulseaudio", binary.parent]


class Browser:
    """One page of a headless browser, 1280 x 800 unless told. ``errors``: what its console complained about."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 800) -> None:
        binary = fetched()
        root = next((p for p in binary.parents if (p / "usr").is_dir()), Path("/"))
        libraries = [str(p) for p in _libraries(root, binary) if p.is_dir()]
        self._process = subprocess.Popen(
            [str(binary), "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0",
             f"--user-data-dir={profile}", f"--window-size={width},{height}", "--hide-scrollbars", "about:blank"],
            env=os.environ | {"LD_LIBRARY_PATH": ":".join(libraries)}, stdout=subprocess.DEVNULL, text=True,
            stderr=subprocess.PIPE,
        )  # fmt: skip
        port = self._port()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as listed:
            page = next(target for target in json.load(listed) if target["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], proxy=None, max_size=None, ping_interval=None)
        self._ids = itertools.count(1)
        self.errors: list[str] = []
        self.hosts: set[str] = set()
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.resize(width, height)

    def resize(self, width: int, height: int) -> None:
        """Of another size, in CSS's pixels."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def _port(self) -> str:
        """Where it listens, which it says first; what it says later is thrown away."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if "DevTools listening on" in line:
                threading.Thread(target=self._process.stderr.read, daemon=True).start()
                return line.partition("127.0.0.1:")[2].partition("/")[0]
        raise OSError(f"the browser ended with {self._process.wait(5)}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(10)

    def call(self, method: str, **parameters: Any) -> Any:
        """A call of the browser's protocol."""
        call_id = next(self._ids)
        self._socket.send(json.dumps({"id": call_id, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._socket.recv(30))
            if said.get("id") == call_id:
                assert "error" not in said, said
                return said["result"]
            self._note(said)

    def _note(self, said: dict[str, Any]) -> None:
        parameters = said.get("params", {})
        if said.get("method") == "Runtime.exceptionThrown":
            self.errors.append(parameters["exceptionDetails"]["exception"]["description"])
        if said.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"]["text"])
        if said.get("method") == "Network.requestWillBeSent":
            url = parameters["request"]["url"]
            if url.startswith("http"):
                self.hosts.add(url.split("/")[2])

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)
        self.until("location.href !== 'about:blank' && document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """What an expression is in the page."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, script: str, timeout_s: float = 30.0) -> Any:
        """Wait until an expression is true in the page."""
        end_s = time.monotonic() + timeout_s
        while not (value := self.run(script)):
            if time.monotonic() > end_s:
                page = self.run("document.body.innerText")
                raise AssertionError(f"never came: {script}\n{self.errors}\n{page}")
            time.sleep(0.03)
        return value

    def text(self, selector: str) -> str:
        """The text of an element."""
        return str(self.run(f"document.querySelector({json.dumps(selector)}).innerText"))

    def click(self, selector: str, hold_s: float = 0.0) -> None:
        """Press the mouse on an element, and let it go."""
        found = f"const e = document.querySelector({json.dumps(selector)})"
        middle = "const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]"
        box = self.run(f"(() => {{ {found}; e.scrollIntoView({{block: 'center'}}); {middle}; }})()")
        for kind in ("mousePressed", "mouseReleased"):
            x, y = box
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
            time.sleep(hold_s if kind == "mousePressed" else 0.0)

    def drag(self, selector: str, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Over an element with the mouse pressed, from and to shares of its width and height."""
        box = self.run(
            f"(() => {{ const r = document.querySelector({json.dumps(selector)}).getBoundingClientRect();"
            " return [r.x, r.y, r.width, r.height]; })()"
        )
        (left, top, width, height), held = box, {"button": "left", "clickCount": 1}
        for kind, (x, y) in (("mousePressed", begin), ("mouseMoved", end), ("mouseReleased", end)):
            self.call("Input.dispatchMouseEvent", type=kind, x=left + x * width, y=top + y * height, buttons=1, **held)

    def press(self, key: str, hold_s: float = 0.0) -> None:
        """Press a key, and let it go."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code="Space" if key == " " else key)
            time.sleep(hold_s if kind == "keyDown" else 0.0)

    def picture(self, file: Path) -> None:
        """A screenshot."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
