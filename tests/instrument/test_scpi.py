"""``pkxyz scpi`` with the programs that laboratories have, PyVISA and PyMeasure."""

import asyncio
import re
from collections.abc import Iterator

import numpy as np
import pytest
import pyvisa
from command_line import beside_a_stage
from pymeasure.adapters import VISAAdapter
from pymeasure.instruments import Instrument, SCPIMixin
from pymeasure.instruments.validators import truncated_range

from pkxyz_ctrl.instrument.axis_moves import AxisMoves
from pkxyz_ctrl.instrument.scpi import HEADERS, LINE_MOST, ScpiSession
from pkxyz_ctrl.instrument.scpi_errors import ErrorQueue, ScpiError

pytestmark = pytest.mark.at_rate


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with beside_a_stage(tmp_path_factory.mktemp("scpi"), "scpi", "--port", "0") as said:
        assert re.fullmatch(r"TCPIP::127\.0\.0\.1::\d+::SOCKET", said)
        yield said


@pytest.fixture
def visa(address: str) -> Iterator[pyvisa.resources.MessageBasedResource]:
    manager = pyvisa.ResourceManager("@py")
    with manager.open_resource(address, read_termination="\n", write_termination="\n", timeout=20_000) as resource:
        yield resource
        assert resource.query("SYST:ERR?") == '0,"No error"'


def test_who_it_is_and_where_it_stands(visa):
    assert visa.query("*IDN?").startswith("pkxyz_ctrl,")
    assert len(visa.query("*idn?").split(",")) == 4
    assert visa.query("STATE?") == "holding"
    assert visa.query("STAT:WORD?") == '"holding its set-point"'
    assert np.allclose(visa.query_ascii_values("POS:TARG?"), [0, 0, 18e-6])
    assert np.allclose(visa.query_ascii_values(":POSition:ACTual?"), [0, 0, 18e-6], atol=50e-9)
    low, high = visa.query_ascii_values("POSITION:LIMITS? X")
    assert (low, high) == pytest.approx((-13.51e-6, 13.51e-6), abs=0.01e-6)


def test_a_move_is_waited_for_and_a_capture_comes_as_a_block(visa):
    visa.write("MOVE X,1e-6,Y,-1e-6")
    assert visa.query("*OPC?") == "1"
    assert visa.query("STATE:POS?") == "1"
    assert np.allclose(visa.query_ascii_values("POS?"), [1e-6, -1e-6, 18e-6], atol=50e-9)
    rows = visa.query_binary_values("CAPT? 0.05", datatype="d", container=np.array).reshape(-1, 9)
    assert len(rows) == 50
    assert (rows[:, 0:3] == [1e-6, -1e-6, 18e-6]).all()
    assert np.allclose(rows[:, 3:6], rows[:, 0:3], atol=50e-9)
    assert (rows[:, 6:9] > 1.0).all()
    assert visa.query("MOVE:REL X,-1e-6;*WAI;:MOVE Y,0;*OPC?") == "1"
    assert np.allclose(visa.query_ascii_values("POS:TARG?"), [0, 0, 18e-6])


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("NONSENSE 1", '-113,"Undefined header;NONSENSE"'),
        ("MOVE", '-109,"Missing parameter;an axis and a target in m: MOVE X,1e-6"'),
        ("MOVE W,1", "-104,\"Data type error;'W' is no axis: X, Y or Z\""),
        ("MOVE X,far", "-104,\"Data type error;'far' is no number\""),
        ("MOVE X,NAN", "-104,\"Data type error;'NAN' is no number\""),
        ("MOVE:VEL 1", '-222,"Data out of range;velocity 1 m/s, limits 0 to 0.0005 m/s"'),
        ("*CLS 1", '-108,"Parameter not allowed;1"'),
        ("CAPT? 100", '-222,"Data out of range;100 s, limits 0 to 10 s"'),
        ("SCAN", '-109,"Missing parameter;the name of a shipped scenario"'),
    ],
)
def test_what_means_nothing_is_an_error_of_the_standard(visa, line, error):
    visa.write(line)
    assert visa.query("SYST:ERR:COUN?") == "1"
    assert visa.query("SYSTEM:ERROR:NEXT?") == error


def test_what_the_combs_cannot_hold_is_out_of_range(visa):
    visa.write("MOVE X,50e-6")
    assert re.match(r'-222,"Data out of range;.*x = 50 um is asked for, limits -13\.51', visa.query("SYST:ERR?"))
    assert np.allclose(visa.query_ascii_values("POS:TARG?"), [0, 0, 18e-6])


def test_a_stop_in_flight(visa):
    visa.write("MOVE:VEL 20e-6;:MOVE X,8e-6")
    assert visa.query("MOVE:VEL?") == "2.000000000E-05"
    while visa.query_ascii_values("POS? X")[0] < 0.5e-6:
        pass
    visa.write("STOP")
    assert visa.query("*OPC?") == "1"
    stands = visa.query_ascii_values("POS:TARG? X")[0]
    assert 0.5e-6 < stands < 7e-6
    visa.write("*RST;MOVE X,0")
    assert visa.query("*OPC?") == "1"


def test_a_line_without_end_is_left_out(visa):
    visa.write("X" * (3 * LINE_MOST))
    assert visa.query("SYST:ERR?") == f'-223,"Too much data;a line has at most {LINE_MOST} bytes"'


class PkxyzStage(SCPIMixin, Instrument):
    """As one writes it for PyMeasure."""

    x = Instrument.control(
        "POS:TARG? X", "MOVE X,%g", "m", validator=truncated_range, values=[-10e-6, 10e-6], check_set_errors=True
    )
    state = Instrument.measurement("STATE?", "in a word", cast=str)


def test_pymeasure_drives_it(address):
    adapter = VISAAdapter(address, visa_library="@py", read_termination="\n", write_termination="\n", timeout=20_000)
    stage = PkxyzStage(adapter, "stage")
    assert stage.id.startswith("pkxyz_ctrl,")
    stage.x = 0.5e-6
    assert stage.complete == "1"
    assert stage.x == 0.5e-6
    assert stage.state == "holding"
    stage.x = 0.0
    assert stage.check_errors() == []
    adapter.close()


def test_two_moves_at_once_and_a_refused_one(visa):
    """The later takes the earlier up; what is refused changes nothing of what is on its way."""
    visa.write("MOVE:VEL 50e-6;:MOVE X,2e-6;:MOVE Y,1e-6;:MOVE Z,1")
    assert visa.query("*OPC?") == "1"
    assert visa.query("SYST:ERR?").startswith("-222,")
    assert np.allclose(visa.query_ascii_values("POS?"), [2e-6, 1e-6, 18e-6], atol=50e-9)
    visa.write("*RST;MOVE X,0,Y,0")
    assert visa.query("*OPC?") == "1"


def test_the_queue_of_errors_tells_the_oldest_first_and_that_it_was_full():
    queue = ErrorQueue()
    for n in range(40):
        queue.put(ScpiError(-113, f"H{n}"))
    assert len(queue) == 32
    told = [queue.take() for _ in range(33)]
    assert told[0] == '-113,"Undefined header;H0"'
    assert told[30:] == ['-113,"Undefined header;H30"', '-350,"Queue overflow"', '0,"No error"']


def test_every_header_has_a_handler_in_long_and_short_form():
    session = ScpiSession(_Nobody())  # type: ignore[arg-type]
    assert set(session._verbs.values()) == HEADERS.keys()
    assert all(callable(getattr(session, f"_{verb}")) for verb in HEADERS)
    assert {"SYST:ERR?", "SYSTEM:ERROR:NEXT?", "POS?", "POSITION:ACTUAL?", "MOVE:VEL?"} <= session._verbs.keys()
    assert asyncio.run(session.answer_to("SYST:VERS?;*IDN?X;ERR?")) == '1999.0;-113,"Undefined header;*IDN?X"'


class _Nobody(AxisMoves):
    """No stage: for what asks none."""

    def __init__(self) -> None:
        self.stage = type("NoStage", (), {"description": {"limits": [1e-3, 1.0, 1e3]}})()
