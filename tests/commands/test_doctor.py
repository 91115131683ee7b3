"""``pkxyz doctor``: what it finds in folders that are as a system's are, and here."""

import json

import pytest
from command_line import pkxyz

from hil.commands.doctor import adapters, governor, how_many_cores, kernel, python

pytestmark = pytest.mark.at_rate


def put(folder, name, text):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text + "\n")


def test_an_adapter_that_is_down_is_bad_and_the_command_is_whole(tmp_path):
    for name, kind, state in (
        ("can0", "280", "down"),
        ("can1", "280", "up"),
        ("eth0", "1", "up"),
        ("vcan0", "280", "unknown"),
    ):
        put(tmp_path, f"class/net/{name}/type", kind)
        put(tmp_path, f"class/net/{name}/operstate", state)
    down, up, virtual = adapters(tmp_path, "bitrate 1000000 dbitrate 5000000 fd on")
    assert down[:3] == ("adapter can0", "bad", "down")
    assert down.remedy == "sudo ip link set can0 up type can bitrate 1000000 dbitrate 5000000 fd on"
    assert up.state == virtual.state == "good"


def test_without_adapter_only_hardware_is_out_of_reach(tmp_path):
    (found,) = adapters(tmp_path, "")
    assert found.state == "could be better"


def test_cores_that_save_power_are_named(tmp_path):
    assert governor(tmp_path).state == "good"
    put(tmp_path, "devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance")
    assert governor(tmp_path).state == "good"
    put(tmp_path, "devices/system/cpu/cpu1/cpufreq/scaling_governor", "powersave")
    found = governor(tmp_path)
    assert (found.state, found.words) == ("could be better", "performance, powersave")
    assert found.remedy.startswith("echo performance")


def test_a_real_time_kernel_is_known_by_either_sign(tmp_path):
    assert kernel(tmp_path, "#1 SMP PREEMPT_DYNAMIC").state == "could be better"
    assert kernel(tmp_path, "#1 SMP PREEMPT_RT Debian").state == "good"
    put(tmp_path, "kernel/realtime", "1")
    assert kernel(tmp_path, "#1 SMP").state == "good"


@pytest.mark.parametrize(("version", "state"), [((3, 10), "bad"), ((3, 11), "good"), ((4, 0), "good")])
def test_python(version, state):
    assert python(version).state == state


def test_one_core_is_too_few_for_comfort():
    assert [how_many_cores(n).state for n in (1, 2)] == ["could be better", "good"]


def test_whatever_lacks_here_has_its_command(tmp_path):
    done = pkxyz("doctor", "--json", "--seconds", "0.2", cwd=tmp_path)
    found = json.loads(done.stdout)
    assert done.returncode == int(any(each["state"] == "bad" for each in found)), done.stderr
    named = {each["what"] for each in found}
    assert {"Python", "cores", "real-time rights", "kernel", "compiled kernels", "extras", "latency"} <= named
    assert all(each["remedy"] or each["state"] == "good" for each in found)
