"""python-canopen's LocalNode, by our EDS: it stores whatever is written, and does little of what it says."""

import canopen

from hil.conformance import simulated
from hil.conformance.run import run_all
from hil.conformance.verdict import DEVIATIONS, Verdict
from hil.node.wired import EDS
from pkxyz_ctrl.can.frame import UNUSUAL, Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load


class Cyclic:
    """A cyclic transmission as canopen asks for one, on the clock of lockstep."""

    def __init__(self, clock, message, period_s, send):
        self.message, self._clock, self._period_us, self._send = message, clock, round(1e6 * period_s), send
        self._ring()

    def _ring(self):
        if self.message is not None:
            self._send(self.message)
            self._clock.call_at(self._clock.now_us + self._period_us, self._ring)

    def stop(self):
        self.message = None

    def modify_data(self, message):
        self.message = message


class LocalNodeModule:
    """What canopen.Network needs of a bus, and the node on it."""

    channel_info = "lockstep"

    def __init__(self, can, clock, send, plant, kind=None):
        self._clock, self._to_wire = clock, send
        self._network = canopen.Network(self)
        self._network.create_node(can.driver.node_id, str(EDS))

    def power_on(self):
        self._network[10].nmt.send_command(129)
        self._network[10].nmt.send_command(128)

    def send(self, message):
        self._to_wire(Frame(message.arbitration_id, bytes(message.data)))

    def send_periodic(self, message, period):
        return Cyclic(self._clock, message, period, self.send)

    def on_frame(self, frame, t_us):
        if not frame.flags & UNUSUAL:
            self._network.notify(frame.can_id, bytearray(frame.data), 1e-6 * t_us)


DEFECTS = {  # it knows neither process data nor states, takes any value, resets nothing, computes no signature
    "object dictionary: read-only objects": "0x1008:00: accepted",
    "object dictionary: mapping in use": "0x1601:00 = 0: accepted",
    "SDO: out of range": "0x1019:00 = 241: accepted",
    "boot-up and NMT: communication reset": "0x1017:00 64 00, default 00 00",
    "boot-up and NMT: SDO by state": "after stop: answered",
    "boot-up and NMT: PDO by state": "after start: none",
    "frames: 29-bit identifiers": "an NMT stop with 29 bits was obeyed",
    "sense PDO: one per SYNC": "60 SYNCs: 0 sense PDOs",
    "sense PDO: latency": "no sense PDO",
    "sense PDO: transmission type": "0 sense PDOs for 30 SYNCs",
    "SYNC: SYNC length": "no EMCY 0x8240",
    "SYNC: SYNC counter": "no EMCY 0x8240",
    "drive PDO: accepted": "0x6411 (0, 0, 0), sent (164, 328, 492)",
    "outputs: heartbeat consumer": "no EMCY 0x8130",
    "digital outputs: RPDO 1": "0x6200:01 after 0x15 in RPDO 1 and a SYNC: 00",
    "signature: of what is read": "0x2020:01 is 0x0000: not the CRC of what its objects read",
}


def test_the_check_is_right_on_its_defects_and_on_none_of_its_virtues(monkeypatch):
    """What was written out of range is not left in 0x6411, nor taken for what a frame with a wrong CRC did."""
    monkeypatch.setattr(simulated, "wired_node", LocalNodeModule)
    talker = simulated.simulated_talker(load("buses", "classic_2k", BusConfig), allow_voltage=True, sample_cycles=60)
    lines = {f"{line.group}: {line.name}": line for line in run_all(talker)}
    deviating = {name: line for name, line in lines.items() if line.verdict in DEVIATIONS}
    assert set(deviating) == set(DEFECTS)
    for name, told in DEFECTS.items():
        assert told in deviating[name].got
    assert [name for name, line in lines.items() if line.verdict is Verdict.UNSAFE] == ["outputs: heartbeat consumer"]
    assert "0x6411 reads (0, 0, 0) after (164, 328, 492)" in lines["drive PDO: wrong CRC"].got
