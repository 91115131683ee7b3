"""``pkxyz doctor``: what this machine has of what a stage needs, and the command that mends what it lacks."""

import json
import platform
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import typer

from hil.screen.options import AsJson
from pkxyz_ctrl.io.realtime import cores

_CAN = "280"  # ARPHRD_CAN of linux/if_arp.h
_LATE_US = 200
_EXTRAS = {"epics": "caproto", "export": "asammdf"}

State = Literal["good", "could be better", "bad"]


class Finding(NamedTuple):
    """One thing that was looked at; ``remedy`` is a command, or empty."""

    what: str
    state: State
    words: str
    remedy: str = ""


def doctor(
    bus: Annotated[str, typer.Option(help="The bus whose bit rates an adapter is to have.")] = "fd_5k",
    seconds: Annotated[float, typer.Option(help="How long to measure how late the loop wakes; 0: not.")] = 2.0,
    as_json: AsJson = False,
) -> None:
    """Look at Python, cores, real-time rights, CAN adapters, kernels and latency; exit code 1 if one is bad."""
    from pkxyz_ctrl.config.bus import BusConfig
    from pkxyz_ctrl.config.files import load

    config = load("buses", bus, BusConfig)
    can = config.can
    rates = "" if can is None else f"bitrate {can.nominal_bitrate_bit_per_s}"
    if can is not None and can.data_bitrate_bit_per_s:
        rates += f" dbitrate {can.data_bitrate_bit_per_s} fd on"
    found = [
        python(sys.version_info[:2]), how_many_cores(cores()), real_time(), kernel(Path("/sys"), platform.version()),
        governor(Path("/sys")), *adapters(Path("/sys"), rates or "bitrate 1000000"), compiled(), extras(),
    ]  # fmt: skip
    if seconds > 0:
        found.append(latency(config.period_us, seconds))
    if as_json:
        print(json.dumps([finding._asdict() for finding in found]))
    else:
        _show(found)
    raise typer.Exit(int(any(finding.state == "bad" for finding in found)))


def python(version: tuple[int, int]) -> Finding:
    """Of which version."""
    good = version >= (3, 11)
    return Finding("Python", "good" if good else "bad", ".".join(map(str, version)), "" if good else "install 3.11")


def how_many_cores(count: int) -> Finding:
    """That this process may use: the loop wants one to itself."""
    if count >= 2:
        return Finding("cores", "good", f"{count}")
    return Finding("cores", "could be better", "1: page and clients take the loop's time", "nproc --all")


def real_time() -> Finding:
    """Whether the loop gets a real-time priority and keeps its memory."""
    from pkxyz_ctrl.io.realtime import go_real_time, leave_real_time

    try:
        words = go_real_time().removeprefix("real time: ").partition("; the loop runs")[0]
    finally:
        leave_real_time()
    if "not permitted" not in words:
        return Finding("real-time rights", "good", words)
    remedy = (
        r"printf '%s - rtprio 95\n%s - memlock unlimited\n' $USER $USER | sudo tee /etc/security/limits.d/pkxyz.conf; "
        r"""echo "KERNEL==\"cpu_dma_latency\", OWNER=\"$USER\"" | sudo tee /etc/udev/rules.d/99-pkxyz.rules"""
    )
    return Finding("real-time rights", "could be better", words, f"{remedy}  # and log in again")


def kernel(sys_folder: Path, version: str) -> Finding:
    """Whether the kernel of the system can be interrupted anywhere."""
    marked = sys_folder / "kernel" / "realtime"
    if "PREEMPT_RT" in version or (marked.is_file() and marked.read_text().strip() == "1"):
        return Finding("kernel", "good", "PREEMPT_RT")
    words = "not PREEMPT_RT: a tick is late now and then"
    return Finding("kernel", "could be better", words, "sudo apt-get install linux-image-rt-amd64")


def governor(sys_folder: Path) -> Finding:
    """Whether cores wait at their full clock."""
    files = sorted(sys_folder.glob("devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    found = {file.read_text().strip() for file in files}
    if not files:
        return Finding("clock of the cores", "good", "not ours to set")
    if found == {"performance"}:
        return Finding("clock of the cores", "good", "performance")
    remedy = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
    return Finding("clock of the cores", "could be better", ", ".join(sorted(found)), remedy)


def adapters(sys_folder: Path, rates: str) -> list[Finding]:
    """CAN interfaces, and whether they are up."""
    found = []
    for folder in sorted((sys_folder / "class" / "net").glob("*")):
        kind, state = folder / "type", folder / "operstate"
        if not kind.is_file() or kind.read_text().strip() != _CAN:
            continue
        is_up = state.is_file() and state.read_text().strip() in ("up", "unknown")
        remedy = "" if is_up else f"sudo ip link set {folder.name} up type can {rates}"
        found.append(Finding(f"adapter {folder.name}", "good" if is_up else "bad", "up" if is_up else "down", remedy))
    return found or [
        Finding("CAN adapters", "could be better", "none; a simulated stage needs none", "ip -details link")
    ]


def compiled() -> Finding:
    """Whether the kernels are compiled already."""
    from pkxyz_ctrl.compiled.quick_load import load_quickly
    from pkxyz_ctrl.loop.cycle import cycle

    load_quickly()
    cache = getattr(cycle, "_cache", None)
    if cache is not None and any(Path(cache.cache_path).glob("cycle.cycle-*.nbi")):
        return Finding("compiled kernels", "good", cache.cache_path)
    return Finding("compiled kernels", "could be better", "not yet: the first start takes a minute", "pkxyz sil")


def extras() -> Finding:
    """Which optional parts are there."""
    lacking = [extra for extra, module in _EXTRAS.items() if find_spec(module) is None]
    if not lacking:
        return Finding("extras", "good", ", ".join(_EXTRAS))
    return Finding("extras", "could be better", f"without {', '.join(lacking)}", _install(lacking))


def latency(period_us: int, seconds: float) -> Finding:
    """How late the loop wakes up here, now."""
    from hil.studies.latency import measure

    figures = measure(period_us, seconds).figures()
    late = figures["lateness_us"]
    words = f"{late['p99_9']} us at p99.9, {late['max']} us at most; {figures['missed_ticks']} ticks of "
    words += f"{figures['period_us']} us missed in {figures['ticks']}"
    if late["p99_9"] < _LATE_US and not figures["missed_ticks"]:
        return Finding("latency", "good", words)
    return Finding("latency", "could be better", words, "pkxyz latency --seconds 30  # with nothing else running")


def _install(lacking: list[str]) -> str:
    return f"pip install 'pkxyz-ctrl[{','.join(lacking)}]'"


def _show(found: list[Finding]) -> None:
    for finding in found:
        print(f"{finding.state:>15}  {finding.what}: {finding.words}")
        if finding.remedy:
            print(f"{'':17}{finding.remedy}")
