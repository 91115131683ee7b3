"""Boots user-mode-linux with CAN in its kernel and runs ``on_vcan.py``, ``on_vcan_native.py`` and ``on_vcan_serve.py``
there, or other files: ``make test-socketcan``.

The host's files are the guest's root, read-only, so it runs this very checkout and its environment, and it has the
host's cache with the kernels that were compiled there. It has one processor, and its clock is not the world's: what is
tested is what happens, not when. Arguments are handed on to pytest.

A guest that does nothing for long, or does not end, is booted once more, and that is said: what stands still there is
the guest's kernel and not what is tested. A test that fails is never tried again.

Exit code 0 if all tests pass, or if the packages cannot be had, which is then said loudly; 1 if not.
"""

import dataclasses
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib.font_manager  # noqa: F401  makes its list of fonts in the cache, which takes a guest a minute

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.native.program import compiled
from hil.runs.scenario import load_scenario

sys.path.append(str(Path(__file__).parents[1] / "fetched"))
from debian import fetched

ROOT = Path(__file__).parent.parent.parent
SCRATCH = ROOT / ".uml"
PACKAGES = ("user-mode-linux", "busybox-static", "can-utils")
TESTS = tuple(f"tests/socketcan/on_vcan{of}.py" for of in ("", "_native", "_serve"))
MODULES = ("drivers/net/can/dev/can-dev", "drivers/net/can/vcan", "net/can/can", "net/can/can-raw", "net/can/can-bcm")
BOOTS = 2
LONGEST_S = 1200  # a guest that has come to a standstill is found long before
STILL_S, STILL_CLOCK_TICKS = 75, 20
"""A guest whose kernel has worked for less than so many clock ticks of 10 ms for so long is dead."""
MEMORY = "2G"  # of which a guest takes what it uses

INIT = """#!{busybox} sh
b={busybox}
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mount -t devtmpfs dev /dev 2>/dev/null
$b mkdir -p /dev/shm
for folder in /run /dev/shm; do $b mount -t tmpfs scratch $folder; done
$b mkdir -p {scratch}
$b mount -t hostfs none {scratch} -o {scratch}
$b mount -t hostfs none {cache} -o {cache}
for module in {modules}; do $b insmod $module || echo "no $module"; done
$b ip link add dev can0 type vcan && $b ip link set can0 mtu 72 && $b ip link set can0 up
$b ip link set lo up
export HOME=/run TMPDIR=/run PATH={path} XDG_CACHE_HOME={cache} PYTHONDONTWRITEBYTECODE=1
cd {root}
exec > {scratch}/report 2>&1
{python} -m pytest -q -n 0 -p no:cacheprovider -x --durations=0 {tests} {chosen}
echo $? > {scratch}/status
$b poweroff -f
"""


def main(chosen: list[str]) -> int:
    """Fetch, boot, wait; returns the exit code. ``chosen``: arguments for pytest."""
    missing = fetched(PACKAGES, SCRATCH / "root")
    if missing:
        print(f"\n*** SKIPPED: test-socketcan, nothing was tested over a real CAN socket: {missing}\n", file=sys.stderr)
        return 0
    begin_s = time.monotonic()
    short = dataclasses.replace(load_scenario("raster").setup(), duration_s=0.02)
    lanes.run(short, Lane.LOCKSTEP, on_block=lambda _: None)  # compiles what is not compiled: a guest takes ten minutes
    compiled()  # the native loop: the host's, as all else
    # a system call of the guest is a change between two of the host's processes, on one processor a fast one
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for boot in range(1, BOOTS + 1):
        ended = _run_guest(chosen)
        passed = _verdict(ended)
        if passed is not None:
            break
        print(f"*** boot {boot} of {BOOTS}: the guest {ended} before its tests had ended\n", file=sys.stderr)
    print(f"{time.monotonic() - begin_s:.0f} s in all, {boot} of at most {BOOTS} guests booted")
    return 0 if passed else 1


def _run_guest(chosen: list[str]) -> str:
    """Boot a guest and wait for its end; says what that was."""
    with tempfile.TemporaryDirectory(prefix="uml-", dir=_memory_folder()) as short:  # its sockets need short paths
        guest = _boot(Path(short), chosen)
        end_s = time.monotonic() + LONGEST_S
        worked, since_s = -1, time.monotonic()
        try:
            while guest.poll() is None:
                now_s = time.monotonic()
                if (done := _clock_ticks(guest.pid)) > worked + STILL_CLOCK_TICKS:
                    worked, since_s = done, now_s
                if now_s - since_s > STILL_S:
                    return f"did nothing for {STILL_S} s"
                if now_s > end_s:
                    return f"did not end within {LONGEST_S} s"
                time.sleep(0.2)
            return "halted"
        finally:
            if guest.poll() is None:
                os.killpg(guest.pid, signal.SIGKILL)
            guest.wait()


def _memory_folder() -> str | None:
    """Where a file is memory and may be executed, as a guest's memory is a file: on a disk, all that it writes to its
    memory is written there as well. None for the usual place.
    """
    shared = "/dev/shm"
    if os.access(shared, os.W_OK) and not os.statvfs(shared).f_flag & os.ST_NOEXEC:
        return shared
    return None


def _clock_ticks(pid: int) -> int:
    """Processor time of a process in units of 10 ms."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:  # gone meanwhile
        return 0
    return int(after_name[11]) + int(after_name[12])


def _boot(short: Path, chosen: list[str]) -> subprocess.Popen[bytes]:
    """Start the guest; ``short`` is a folder for its memory and its sockets."""
    scratch = SCRATCH / "guest"
    scratch.mkdir(exist_ok=True)
    for name in ("status", "report"):
        (scratch / name).unlink(missing_ok=True)
    (kernel,) = (SCRATCH / "root/usr/lib/uml/modules").glob("*/kernel")
    init = scratch / "init"
    values = {
        "busybox": SCRATCH / "root/bin/busybox",
        "modules": " ".join(shlex.quote(f"{kernel / module}.ko") for module in MODULES),
        "scratch": scratch,
        "cache": os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache",
        "path": f"{os.environ['PATH']}:{SCRATCH / 'root/usr/bin'}",
        "tests": shlex.join(test for test in TESTS if not any(word.startswith("tests/") for word in chosen)),
        "python": sys.executable,
        "root": ROOT,
        "chosen": shlex.join(chosen),
    }
    ready = ("modules", "chosen", "tests")
    quoted = {key: value if key in ready else shlex.quote(str(value)) for key, value in values.items()}
    init.write_text(INIT.format(**quoted), encoding="utf-8")
    init.chmod(0o755)
    words = [
        SCRATCH / "root/usr/bin/linux.uml", f"mem={MEMORY}", "root=/dev/root", "rootfstype=hostfs",
        "rootflags=/", "ro", f"init={init}", "con=null", "con0=null,fd:2", "con1=null", "ssl=null", "quiet",
        "umid=vcan", f"uml_dir={short}/",
    ]  # fmt: skip
    env = {**os.environ, "HOME": str(short), "TMPDIR": str(short)}
    with (scratch / "console").open("wb") as console:
        return subprocess.Popen(
            words, env=env, stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True
        )


def _verdict(ended: str) -> bool | None:
    """Whether the tests passed, None if they did not come to an end; says what they said."""
    scratch = SCRATCH / "guest"
    status, report, console = (scratch / name for name in ("status", "report", "console"))
    if report.is_file():
        print(report.read_text(encoding="utf-8", errors="replace"))
    if not status.is_file():
        print(f"the guest {ended} without a verdict\n{console.read_text(encoding='utf-8', errors='replace')[-3000:]}")
        return None
    return status.read_text(encoding="utf-8").strip() == "0"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
