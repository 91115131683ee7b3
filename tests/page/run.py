"""The page of ``pkxyz serve``, driven by a headless Chromium as a person would: ``make test-page``.

It fetches Debian's package (100 MB, once) where the system has no Chromium. Pictures of it go to a folder; with
``--docs`` those of docs/do/operate.md are drawn anew, too. With ``--goes 3`` it has passed if one of three goes does,
as a machine may stand still.

Exit code 0 if it passes, or if no browser can be had, which is then said loudly; 1 if not.
"""

import argparse
import faulthandler
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser, fetched
from numpy.typing import NDArray

import pkxyz_ctrl
from pkxyz_ctrl.client.reply import RefusedError

_STUCK_S = 400.0
DOCS_FIGURES = Path(__file__).parents[2] / "docs" / "figures"


def activity(browser: Browser, *wanted: str, timeout_s: float = 60.0) -> None:
    names = json.dumps(wanted)
    browser.until(f"{names}.includes(document.querySelector('.state').dataset.activity)", timeout_s)


def logged(browser: Browser, words: str, timeout_s: float = 30.0) -> None:
    browser.until(f"document.querySelector('#log').innerText.includes({json.dumps(words)})", timeout_s)


def fill(browser: Browser, selector: str, value: str) -> None:
    browser.run(f"document.querySelector({json.dumps(selector)}).value = {json.dumps(value)}")


def come_up(folder: Path, url: str, begin_s: float) -> None:
    """Tell how long it took from Enter to a page whose clock runs, and from another's address to its first plot."""
    drawn = "document.querySelector('#plot canvas') && document.querySelector('#facts').innerText.includes('running')"
    for name, asked_s in (("a living page, from Enter", 5), ("a first plot, from the address", 1)):
        with Browser(folder / name) as browser:
            opened_s = time.monotonic()
            browser.open(url)
            browser.until(drawn, 200)
            print(f"{name}: {time.monotonic() - (begin_s or opened_s):.2f} s, {asked_s} are asked")
        begin_s = 0.0


def operate(browser: Browser, url: str, pictures: Path) -> None:
    """Everything that a person does in a morning."""
    browser.open(url)
    activity(browser, "off", timeout_s=120)
    assert "#" not in browser.run("location.href"), "the token stays in no history"
    browser.picture(pictures / "off.png")
    assert browser.run("document.querySelector('[data-do=home]').disabled"), "read-only until control is taken"
    browser.click("#control")
    browser.until("document.querySelector('#control').innerText === 'Give control'")
    try:
        pkxyz_ctrl.connect(name="page").__enter__()
        raise AssertionError("a second one got control")
    except RefusedError as refused:
        assert "another client has control" in str(refused)  # noqa: PT017
    browser.click("[data-do=home]")
    logged(browser, "home done")
    browser.click("[data-do=enable]")
    logged(browser, "enable done")
    browser.click("#middle")
    logged(browser, "move done")
    activity(browser, "holding")
    assert "stage.move_to(x=0, y=0, z=0.0000192495269)" in browser.text("#as-python")
    set_up(browser, pictures)
    fill(browser, "#move [name=x_m]", "50")
    browser.click("#move button:not([type])")
    logged(browser, "x = 50 um is asked for, limits")
    ghost(browser, pictures)
    look_closer(browser)
    fill(browser, "#scan [name=lines]", "200")
    fill(browser, "#scan [name=pitch]", "0.02")
    fill(browser, "#scan [name=rate]", "8")  # 25 s: a browser without a graphics card takes seconds for a picture
    browser.click("#scan button:not([name])")
    activity(browser, "scanning")
    fill(browser, "#shown", "position")
    browser.run("document.querySelector('#shown').onchange()")
    time.sleep(0.5)
    browser.run("scrollTo(0, 0)")
    browser.picture(pictures / "scan.png")
    fill(browser, "#view", "3d")
    browser.run("document.querySelector('#view').onchange()")
    browser.click("#theme")
    time.sleep(0.5)
    browser.picture(pictures / "scan-dark.png")
    browser.resize(820, 1180)
    browser.picture(pictures / "tablet.png")
    browser.resize(1280, 800)
    browser.click("#theme")
    browser.click("[data-do=pause]")
    activity(browser, "paused")
    browser.click("[data-do=resume]")
    activity(browser, "scanning")
    browser.press(" ")  # Space: stop
    activity(browser, "holding")
    logged(browser, "path aborted")
    browser.click("#theme")
    browser.click("#spectrum")
    time.sleep(1.0)
    browser.picture(pictures / "spectrum-dark.png")
    browser.click("[data-do=release]")
    activity(browser, "fault")
    browser.until("!document.querySelector('#fault').hidden && document.body.innerText.includes('Stopped by hand')")
    browser.until("document.querySelector('#fault-words').innerText.includes('The 2 s before it: ')")
    browser.picture(pictures / "fault.png")
    look_back(browser, pictures)
    browser.click("#fault [data-do=clear]")
    activity(browser, "off")
    for verb in ("home", "enable"):
        browser.click(f"[data-do={verb}]")
        newest = f"document.querySelector('#log').innerText.trim().startsWith('{verb} done')"  # there are older ones
        browser.until(newest)
    activity(browser, "holding")


def set_up(browser: Browser, pictures: Path) -> None:
    """Window, law, axes of the sample, a position with a name, and the way back."""
    settings_px = browser.run("document.querySelector('#settings').offsetTop")
    fill(browser, "#settle [name=window]", "25")
    browser.click("#settle button")
    logged(browser, "settle done: settle window: settings ")
    browser.click("#quiet")
    logged(browser, "quiet done: holds are quiet")
    assert "stage.quiet_holds(True)" in browser.text("#as-python")
    browser.click("#quiet")
    logged(browser, "quiet done: holds are as stiff as moves")
    assert browser.run("document.querySelector('#settings').offsetTop") == settings_px, "what is asked moves no button"
    other_laws(browser, pictures)
    standing(browser)
    fill(browser, "#sample [name=origin_z]", "19")
    fill(browser, "#sample [name=rotation]", "30")
    browser.click("#sample button:not([type])")
    logged(browser, "sample done: ")
    browser.until("document.querySelector('#facts').innerText.includes('sample')")
    assert "rotation_deg=30" in browser.text("#as-command")
    fill(browser, "#name-position [name=name]", "corner")
    browser.click("#name-position button")
    browser.until("document.querySelector('#positions').innerText.includes('corner: ')")
    fill(browser, "#move [name=x_m]", "1.5")
    browser.click("#move button:not([type])")
    logged(browser, "in position at (1.5, ")
    browser.click("#positions button")
    logged(browser, "in position at (0, ")
    browser.click("#tree-open")
    browser.until("document.querySelector('#tree').innerText.includes('reference_m')")
    browser.run("for (const each of document.querySelectorAll('#settings details, #tree details')) each.open = true")
    browser.run("document.querySelector('#settings').scrollIntoView()")
    time.sleep(0.6)
    browser.picture(pictures / "settings.png")
    browser.click("#tree-open")
    browser.run("[...document.querySelectorAll('#history button')].at(-1).click()")
    logged(browser, "restore done: back to ")
    browser.until("document.querySelector('#facts').innerText.includes('stage')")


def other_laws(browser: Browser, pictures: Path) -> None:
    """One that this bus can't have is refused with the reason, before the list says so and after; another, and back."""
    fill(browser, "#law-form [name=law]", "robust")
    browser.click("#law-form button:not([type])")
    logged(browser, "period_us is 200 and the bus has 500 us", 200)  # begins a process of its own
    browser.run("document.querySelector('#law-form [name=law]').focus()")
    browser.until("document.querySelector('#law-not').innerText.includes('no robust: linear.period_us is 200')", 200)
    can_be_had = "[...document.querySelectorAll('#law-form option')].filter((o) => !o.disabled).map((o) => o.value)"
    assert browser.run(can_be_had) == ["youla", "lqg", "pi_notch"]
    for name in ("lqg", "youla"):
        fill(browser, "#law-form [name=law]", name)
        browser.click("#law-form button:not([type])")
        logged(browser, f"law done: the law is {name}", 200)
        browser.until(f"document.querySelector('#law-now').innerText === 'now {name}'")
        assert f'stage.change_law("{name}")' in browser.text("#as-python")
        activity(browser, "holding")
    browser.run("document.querySelector('#law-form').scrollIntoView({block: 'center'})")
    browser.picture(pictures / "laws.png")


def standing(browser: Browser) -> None:
    """A set-point that stands has no density; labels for its rounding, of any decade, were drawn without end."""
    for shown in ("position", "error"):
        fill(browser, "#shown", shown)
        browser.run("document.querySelector('#shown').onchange()")
        browser.click("#spectrum")
        time.sleep(0.3)
        assert browser.text("#plot .u-legend").startswith("Hz"), "it is still drawn"
        browser.click("#spectrum")


DRAWN = "document.querySelector('#plot canvas').toDataURL()"
KEPT = """(() => {
    window.kept = {};
    HTMLAnchorElement.prototype.click = function () { window.kept[this.download] = this.href; };
    const place = URL.createObjectURL;
    URL.createObjectURL = (blob) => { window.blob = blob; return place.call(URL, blob); };
})()"""
"""What is saved from now on stays in the page: names with addresses, and the newest file."""


def look_closer(browser: Browser) -> None:
    """The scope by what it saves: begun by a set-point that it doesn't show; it stands while paused, and is zoomed."""
    browser.run(KEPT)
    fill(browser, "#level", "2.5")
    fill(browser, "#trigger", "x")
    fill(browser, "#shown", "voltage")
    for chosen in ("level", "trigger", "shown"):
        browser.run(f"document.querySelector('#{chosen}').onchange()")
    assert saved(browser)["time_s"][-1] == pytest.approx(0.0, abs=0.005), "nothing has passed there yet"
    fill(browser, "#move [name=x_m]", "3")
    browser.click("#move button:not([type])")
    logged(browser, "in position at (3, 0, ")
    time.sleep(1.2)  # half of what is shown lies behind
    columns = saved(browser)
    assert columns["comb_1_V"].max() > 100.0
    assert columns["time_s"][-1] == pytest.approx(1.0, abs=0.005)
    fill(browser, "#shown", "position")
    browser.run("document.querySelector('#shown').onchange()")
    columns = saved(browser)
    place_um, time_s = columns["set-point_x_um"], columns["time_s"]
    passes = np.argmin(np.abs(time_s))
    assert place_um[passes - 2] < 2.5 < place_um[passes + 2], "a point is a millisecond"
    assert place_um[0] < 0.01 < 2.99 < place_um[-1]
    browser.click("#hold")
    browser.run(f"window.held = {DRAWN}")
    time.sleep(0.5)
    assert browser.run(f"{DRAWN} === window.held"), "it stands"
    browser.drag("#plot .u-over", (0.4, 0.3), (0.6, 0.7))
    browser.until(f"{DRAWN} !== window.held")
    browser.click("#png")
    assert browser.run(f"window.kept['scope.png'] === {DRAWN}"), "a picture of what is seen"
    browser.click("#hold")
    fill(browser, "#trigger", "none")
    browser.run("document.querySelector('#trigger').onchange()")


def saved(browser: Browser) -> dict[str, NDArray[np.float64]]:
    """What the scope shows, once it is drawn anew, by the names of its columns."""
    time.sleep(0.3)
    browser.click("#csv")
    assert str(browser.run("window.kept['scope.csv']")).startswith("blob:")
    names, *rows = str(browser.run("window.blob.text()")).splitlines()
    return dict(zip(names.split(","), np.array([row.split(",") for row in rows], np.float64).T, strict=True))


def by_hand(browser: Browser) -> None:
    """Moved for as long as a key is down and the window is looked at, and braked because of that, not of silence."""
    fill(browser, "#step", "0")
    browser.run("document.querySelector('#step').onchange(); document.querySelector('#middle').click()")
    logged(browser, "move done")
    for end in ("new KeyboardEvent('keyup', {key: 'ArrowRight'})", "new Event('blur')"):
        browser.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))")
        activity(browser, "jogging")
        browser.run(f"dispatchEvent({end})")
        activity(browser, "holding", timeout_s=5)
        newest = "document.querySelector('#log').innerText.trim().split('\\n')[0]"
        browser.until(f"{newest}.startsWith('jog done') && {newest}.endsWith('the jog was ended')")


GREY = """(() => {
    const c = document.querySelector("#plane"), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let count = 0;
    for (let n = 0; n < d.length; n += 4)
        count += d[n + 3] > 120 && d[n] > 85 && d[n] < 175 && Math.abs(d[n] - d[n + 1]) < 25 && d[n + 2] - d[n] < 45;
    return count;
})()"""
"""How many pixels in the view of the position are as grey as a path to come is drawn, in light colours."""


def ghost(browser: Browser, pictures: Path) -> None:
    """A path that is only looked at is drawn in space, to the ends of its lines, and nothing moves."""
    fill(browser, "#view", "3d")
    browser.run("document.querySelector('#view').onchange()")
    time.sleep(0.5)
    before = int(browser.run(GREY))
    browser.click("#scan [name=preview]")
    browser.until("document.querySelector('#scan-words').innerText.includes('the combs can follow')")
    browser.until(f"{GREY} > {before + 150}")
    browser.run("scrollTo(0, 0)")
    browser.picture(pictures / "ghost.png")
    assert "from (-2.27, -1.90, " in browser.text("#scan-words"), browser.text("#scan-words")
    activity(browser, "holding")
    fill(browser, "#view", "xy")
    browser.run("document.querySelector('#view').onchange()")


def look_back(browser: Browser, pictures: Path) -> None:
    """What was kept of the fault, in the same page, with its events; then live again."""
    browser.until("document.querySelector('#recordings').innerText.includes('fault-')")
    browser.click("#recordings button")
    browser.until("!document.querySelector('#opened').hidden")
    browser.run("document.querySelector('#span').value = '0.5'; document.querySelector('#span').onchange()")
    browser.until("!document.querySelector('#opened-at').disabled")
    assert "Stopped by hand" in browser.text("#opened-words")
    time.sleep(0.5)
    browser.picture(pictures / "recording.png")
    browser.run(f"window.newest = {DRAWN}")
    browser.run("document.querySelector('#opened-at').value = 0; document.querySelector('#opened-at').oninput()")
    browser.until(f"{DRAWN} !== window.newest")
    browser.click("#opened-close")
    browser.until("document.querySelector('#opened').hidden")


def go(pictures: Path) -> None:
    """All of it once."""
    faulthandler.dump_traceback_later(_STUCK_S, exit=False)
    folder = Path(tempfile.mkdtemp(prefix="pkxyz-served-"))
    words = ["--silence-s", "0.25", "--saves", str(folder / "runs"), "--settings", str(folder / "settings")]
    begin_s = time.monotonic()
    serving = subprocess.Popen(
        [sys.executable, "-m", "hil", "serve", "--name", "page", "--port", "0", "--json", *words],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert serving.stdout is not None
        url = json.loads(serving.stdout.readline())["url"]
        come_up(folder, url, begin_s)
        with Browser(folder / "browser") as browser:
            operate(browser, url, pictures)
            assert browser.hosts == {url.split("/")[2]}, browser.hosts
            assert browser.errors == [], browser.errors
            by_hand(browser)
            browser.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))")
            activity(browser, "jogging")
        with pkxyz_ctrl.connect(name="page") as stage:  # the tab is closed: control is free, and the jog has ended
            time.sleep(0.4)
            assert stage.status.activity == "holding", stage.status.words
            stage.park()
    finally:
        serving.send_signal(signal.SIGINT)
        try:
            serving.wait(20)
        except subprocess.TimeoutExpired:
            serving.kill()
            raise


def passed(pictures: Path, goes: int) -> bool:
    """Whether one of so many goes does; what was wrong in the others is told."""
    for n in range(goes):
        try:
            go(pictures)
        except Exception:
            traceback.print_exc()
            print(f"go {n + 1} of {goes} has failed", file=sys.stderr)
        else:
            return True
    return False


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs="?", type=Path, help="folder for pictures; left out, a new one")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--goes", type=int, default=1)
    asked = parser.parse_args()
    try:
        fetched()
    except OSError as error:
        print(f"\n*** SKIPPED: test-page, nothing was tested in a browser: {error}\n", file=sys.stderr)
        return 0
    pictures = asked.pictures or Path(tempfile.mkdtemp(prefix="pkxyz-page-"))
    pictures.mkdir(parents=True, exist_ok=True)
    begin_s = time.monotonic()
    if not passed(pictures, asked.goes):
        return 1
    if asked.docs:
        for name, theme in (("scan", "light"), ("scan-dark", "dark")):
            shutil.copyfile(pictures / f"{name}.png", DOCS_FIGURES / f"page-{theme}.png")
    print(f"the page does what it should, in {time.monotonic() - begin_s:.0f} s; pictures are in {pictures}{os.sep}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
