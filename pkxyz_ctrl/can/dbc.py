"""The DBC of a bus, generated from the EDS, for cantools, python-can's viewer and everything else that reads DBCs."""

import re
from collections import OrderedDict
from pathlib import Path

import canopen
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from . import cob_id
from .cob_id import NmtCommand, NmtState
from .codec import OUTPUT_NAMES, AnalogScale
from .driver_config import DriverConfig

CONTROLLER = "Controller"
AMPLIFIER = "Amplifier"
GENERATED = "generated from "
"""How the version of every DBC begins that was written here."""

_DRIVE_INDEX = 0x6411
_SENSE_INDEX = 0x6401
_OUTPUT_INDEX = 0x6200
_PROTECTION = (0x2000, 0x2001)  # alive counter and CRC-8 of both process PDOs
_SIGNED_TYPES = canopen.objectdictionary.datatypes.SIGNED_TYPES
_FEMTO = 1e15


def database_from_eds(
    eds_path: Path, driver: DriverConfig, drive_scale: AnalogScale, sense_scale: AnalogScale, origin: str
) -> Database:
    """Every frame between the controller that ``driver`` configures and the amplifier of the EDS.

    PDO signals follow the EDS's mapping, without alive counter and CRC if the driver has no protection; drive combs are
    scaled to V with ``drive_scale`` (V per count), sense combs to fF with ``sense_scale`` (F per count, F). Raw values
    are the counts. ``origin``, one line, tells a reader of the file where it is from.
    """
    node_id = driver.node_id
    dictionary = canopen.import_od(str(eds_path), node_id)
    conversions = {
        _DRIVE_INDEX: ("V", _conversion(drive_scale, 1.0)),
        _SENSE_INDEX: ("fF", _conversion(sense_scale, _FEMTO)),
    }
    messages = [
        _message(
            cob_id.NMT, "NMT", CONTROLLER, [_enumerated("NMT_command", 0, NmtCommand), _unsigned("NMT_node", 8, 8)]
        ),
        _message(dictionary[0x1005].default, "SYNC", CONTROLLER, [_sync_counter(dictionary)]),
        _message(dictionary[0x1014].default, "EMCY", AMPLIFIER, _emergency_signals()),
        _message(dictionary[0x1200][1].default, "SDO_request", CONTROLLER, _sdo_signals("SDO_request")),
        _message(dictionary[0x1200][2].default, "SDO_response", AMPLIFIER, _sdo_signals("SDO_response")),
        _heartbeat(AMPLIFIER, node_id),
        _heartbeat(CONTROLLER, driver.controller_node_id),
    ]
    unused = {0x1400: driver.output_id < 0, 0x1802: driver.signature_id < 0}
    for index in dictionary:
        if unused.get(index):
            continue
        if 0x1400 <= index < 0x1600:
            messages.append(_pdo(dictionary, index, CONTROLLER, conversions, protected=driver.protection))
        elif 0x1800 <= index < 0x1A00:
            messages.append(_pdo(dictionary, index, AMPLIFIER, conversions, protected=driver.protection))
    return Database(
        messages=sorted(messages, key=lambda message: message.frame_id),
        nodes=[Node(CONTROLLER, "pkxyz_ctrl, the CANopen master"), Node(AMPLIFIER, f"comb amplifier, node {node_id}")],
        version=f"{GENERATED}{origin}",
    )


def dbc_text(database: Database) -> str:
    """The DBC file's content, with line feeds only."""
    return str(database.as_dbc_string()).replace("\r\n", "\n")


def _pdo(
    dictionary: canopen.ObjectDictionary,
    index: int,
    sender: str,
    conversions: dict[int, tuple[str, BaseConversion]],
    *,
    protected: bool,
) -> Message:
    communication, entries = dictionary[index], dictionary[index + 0x200]
    signals = []
    bit = 0
    for place in range(1, entries[0].default + 1):
        entry = entries[place].default
        mapped_index, subindex, length = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        if mapped_index in _PROTECTION and not protected:
            continue
        variable = dictionary.get_variable(mapped_index, subindex)
        if mapped_index == _OUTPUT_INDEX:
            signals += [Signal(f"Trigger_{_identifier(name)}", bit + n, 1) for n, name in enumerate(OUTPUT_NAMES)]
            bit += length
            continue
        unit, conversion = conversions.get(mapped_index, (None, BaseConversion.factory()))
        is_signed = variable.data_type in _SIGNED_TYPES
        lowest, highest = (-(1 << length - 1), (1 << length - 1) - 1) if is_signed else (0, (1 << length) - 1)
        limits = (
            _twelve_digits(float(conversion.raw_to_scaled(lowest if variable.min is None else variable.min))),
            _twelve_digits(float(conversion.raw_to_scaled(highest if variable.max is None else variable.max))),
        )
        signals.append(
            Signal(
                _identifier(variable.name),
                bit,
                length,
                is_signed=is_signed,
                conversion=conversion,
                minimum=limits[0],
                maximum=limits[1],
                unit=unit,
                receivers=[_other(sender)],
                comment=f"object 0x{mapped_index:04X}:{subindex:02X}",
            )
        )
        bit += length
    named = re.fullmatch(r"([RT]PDO) (\d+) communication parameter \((\w+)\)", communication.name)
    if named is None:
        raise ValueError(
            f"object 0x{index:04X}: '{communication.name}' is not '[RT]PDO n communication parameter (role)'"
        )
    return _message(communication[1].default & 0x7FF, f"{named[1]}{named[2]}_{named[3]}", sender, signals)


def _message(frame_id: int, name: str, sender: str, signals: list[Signal]) -> Message:
    length = (max(signal.start + signal.length for signal in signals) + 7) // 8
    for signal in signals:
        signal.receivers = [_other(sender)]
    return Message(frame_id, name, length, signals, senders=[sender], strict=True)


def _heartbeat(sender: str, node_id: int) -> Message:
    state = _enumerated(f"{sender}_state", 0, NmtState)
    return _message(cob_id.HEARTBEAT_BASE + node_id, f"Heartbeat_{sender}", sender, [state])


def _sync_counter(dictionary: canopen.ObjectDictionary) -> Signal:
    return Signal("SYNC_counter", 0, 8, minimum=1, maximum=dictionary[0x1019].default)


def _emergency_signals() -> list[Signal]:
    manufacturer = [_unsigned(f"EMCY_manufacturer_{place}", 8 * place + 16, 8) for place in range(1, 6)]
    return [_unsigned("EMCY_code", 0, 16), _unsigned("EMCY_register", 16, 8), *manufacturer]


def _sdo_signals(prefix: str) -> list[Signal]:
    return [
        _unsigned(f"{prefix}_command", 0, 8),
        _unsigned(f"{prefix}_index", 8, 16),
        _unsigned(f"{prefix}_subindex", 24, 8),
        _unsigned(f"{prefix}_data", 32, 32),
    ]


def _unsigned(name: str, start: int, length: int) -> Signal:
    return Signal(name, start, length, minimum=0, maximum=(1 << length) - 1)


def _enumerated(name: str, start: int, numbers: type[NmtCommand] | type[NmtState]) -> Signal:
    choices = OrderedDict((int(number), number.name) for number in numbers)
    return Signal(name, start, 8, conversion=BaseConversion.factory(choices=choices), minimum=0, maximum=255)


def _conversion(scale: AnalogScale, unit_factor: float) -> BaseConversion:
    return BaseConversion.factory(
        scale=_twelve_digits(scale.scale * unit_factor), offset=_twelve_digits(scale.offset * unit_factor)
    )


def _twelve_digits(value: float) -> float:
    # What a DBC reader needs, without the last digits of binary fractions.
    return float(f"{value:.12g}")


def _other(sender: str) -> str:
    return AMPLIFIER if sender == CONTROLLER else CONTROLLER


def _identifier(name: str) -> str:
    return re.sub(r"\W+", "_", name)
