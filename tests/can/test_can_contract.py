"""The EDS is the contract: canopen on the EDS, cantools on the DBC and our codec agree on every byte."""

import logging
from configparser import RawConfigParser
from pathlib import Path

import canopen
import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from object_tables import object_table, pdo_table

from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.codec import DRIVE_SCALE, ProcessCodec
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.startup import configuration_steps, identity_steps, mapping

ROOT = Path(__file__).resolve().parents[2]
EDS = ROOT / "configs" / "comb_amplifier.eds"
DBC = ROOT / "configs" / "comb_amplifier.dbc"

counts = st.integers(-32768, 32767)
drive_counts = st.integers(0, 32767)
alive = st.integers(0, 255)


@pytest.fixture(scope="module")
def dictionary() -> canopen.ObjectDictionary:
    return canopen.import_od(str(EDS), 10)


@pytest.fixture(scope="module")
def dbc() -> cantools.database.Database:
    return cantools.database.load_file(DBC)


@pytest.fixture(scope="module")
def canopen_pdos(dictionary) -> dict[str, canopen.pdo.base.PdoMap]:
    node = canopen.Network().create_node(10, dictionary)  # a network without a bus: the maps only pack bytes
    node.rpdo[2].read(from_od=True)
    node.tpdo[2].read(from_od=True)
    return {"drive": node.rpdo[2], "sense": node.tpdo[2]}


def test_canopen_reads_the_eds_without_complaint(caplog):
    with caplog.at_level(logging.DEBUG):
        canopen.import_od(str(EDS), 10)
    assert caplog.records == []


def test_the_eds_names_every_object_it_has_and_no_other(dictionary):
    eds = RawConfigParser(inline_comment_prefixes=(";",))
    eds.read(EDS)
    listed = []
    for part in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        numbers = [int(value, 0) for key, value in eds[part].items() if key != "supportedobjects"]
        assert len(numbers) == int(eds[part]["SupportedObjects"])
        listed += numbers
    assert sorted(listed) == sorted(dictionary)
    for index in dictionary:
        section = f"{index:04X}"
        subs = [name for name in eds.sections() if name.lower().startswith(section.lower() + "sub")]
        assert len(subs) == int(eds.get(section, "SubNumber", fallback="0")), section
        if subs and index not in (0x1003, 0x1600, 0x1601, 0x1A01, 0x1A02):  # there sub 0 counts what is in use
            assert dictionary[index][0].default == max(int(name[7:], 16) for name in subs), section


@pytest.mark.parametrize("node_id", [1, 10, 126])
def test_cob_ids_follow_the_predefined_connection_set(node_id):
    od = canopen.import_od(str(EDS), node_id)
    assert od[0x1401][1].default == cob_id.DRIVE_BASE + node_id
    assert od[0x1801][1].default == cob_id.SENSE_BASE + node_id | cob_id.COB_ID_NO_RTR
    assert od[0x1400][1].default == cob_id.OUTPUT_BASE + node_id
    off = cob_id.COB_ID_INVALID | cob_id.COB_ID_NO_RTR
    assert od[0x1802][1].default == cob_id.sense(node_id, cob_id.SIGNATURE_PDO) | off, "nobody has to know it"
    assert od[0x1014].default == cob_id.EMCY_BASE + node_id
    assert [od[0x1200][1].default, od[0x1200][2].default] == [0x600 + node_id, 0x580 + node_id]
    assert od[0x1005].default == cob_id.SYNC
    assert od[0x1019].default == cob_id.SYNC_COUNTER_OVERFLOW


def test_default_state_is_safe(dictionary):
    assert [dictionary[0x6443][comb].default for comb in (1, 2, 3)] == [1, 1, 1]
    assert [dictionary[0x6444][comb].default for comb in (1, 2, 3)] == [0, 0, 0]
    assert dictionary[0x1029][1].default == 0
    assert all(dictionary[0x6411][comb].min == 0 for comb in (1, 2, 3))


@pytest.mark.parametrize("protection", [True, False])
def test_the_start_up_writes_only_what_the_eds_offers(dictionary, protection):
    config = DriverConfig(protection=protection, digital_outputs=True, signature_syncs=240)
    for step in identity_steps(config) + configuration_steps(config):
        variable = dictionary.get_variable(step.index, step.subindex)
        assert variable is not None, step.name
        assert len(variable) == 8 * step.size, step.name
        assert variable.writable or not step.write, step.name
        if not step.write and step.index in (0x1000, 0x1018):
            assert (step.value ^ variable.default) & ~step.alike == 0, step.name


def test_the_start_up_mapping_is_the_default_mapping(dictionary):
    for index, entries in (
        (0x1601, mapping(0x6411, 0x2000, True)),
        (0x1A01, mapping(0x6401, 0x2001, True)),
        (0x1600, (0x62000108,)),
        (0x1A02, (0x20200110,)),
    ):
        assert tuple(dictionary[index][place].default for place in range(1, 1 + len(entries))) == entries
        assert dictionary[index][0].default == len(entries)
        for entry in entries:
            assert dictionary.get_variable(entry >> 16, entry >> 8 & 0xFF).pdo_mappable


@settings(max_examples=150)
@given(st.tuples(drive_counts, drive_counts, drive_counts), alive)
def test_drive_pdo_equals_cantools_and_canopen(dbc, canopen_pdos, values, counter):
    payload = ProcessCodec(0x30A, protected=True).encode(values, counter)
    signals = {f"Drive_comb_{comb}": value for comb, value in enumerate(values, 1)}
    signals |= {"Drive_alive_counter": counter, "Drive_CRC_8": payload[7]}
    message = dbc.get_message_by_frame_id(0x30A)
    assert message.encode(signals, scaling=False) == payload
    assert message.decode(payload, scaling=False) == signals
    volts = message.decode(payload)
    for comb, value in enumerate(values, 1):
        assert volts[f"Drive_comb_{comb}"] == pytest.approx(DRIVE_SCALE.physical(value), rel=1e-11)
    assert canopen_payload(canopen_pdos["drive"], values, counter, payload[7]) == payload


@settings(max_examples=150)
@given(st.tuples(counts, counts, counts), alive)
def test_sense_pdo_equals_cantools_and_canopen(dbc, canopen_pdos, values, counter):
    """Femtofarads by the scale of ``configs/buses/fd_5k.toml``: 4.14 pF and 68 aF a count."""
    payload = ProcessCodec(0x28A, protected=True).encode(values, counter)
    signals = {f"Sense_comb_{comb}": value for comb, value in enumerate(values, 1)}
    signals |= {"Sense_alive_counter": counter, "Sense_CRC_8": payload[7]}
    message = dbc.get_message_by_frame_id(0x28A)
    assert message.encode(signals, scaling=False) == payload
    assert message.decode(payload, scaling=False) == signals
    femtofarads = message.decode(payload)
    for comb, value in enumerate(values, 1):
        assert femtofarads[f"Sense_comb_{comb}"] == pytest.approx(4140 + 0.068 * value, rel=1e-11)
    assert canopen_payload(canopen_pdos["sense"], values, counter, payload[7]) == payload


def canopen_payload(pdo, values, counter, crc) -> bytes:
    """The PDO as canopen packs it, from the EDS's mapping entries alone."""
    for variable, value in zip(pdo, (*values, counter, crc), strict=True):
        variable.raw = value
    return bytes(pdo.data)


def test_the_document_shows_the_tables_of_the_eds(dictionary):
    rows = [line.strip("| ").split(" | ") for line in pdo_table(dictionary).splitlines()[2:]]
    for cob, entries in (("0x30A", mapping(0x6411, 0x2000, True)), ("0x28A", mapping(0x6401, 0x2001, True))):
        places, objects = zip(*((place, what) for told, place, what, *_ in rows if told == cob), strict=True)
        assert places == ("0..1", "2..3", "4..5", "6", "7")
        assert objects == tuple(f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF:02X}" for entry in entries)
    listed = [line.split(" | ")[0].strip("| ") for line in object_table(dictionary).splitlines()[2:]]
    members = (m for entry in dictionary.values() for m in (entry.values() if hasattr(entry, "values") else [entry]))
    offered = {f"0x{m.index:04X}:{m.subindex:02X}" for m in members if m.subindex or m.access_type != "const"}
    assert offered <= set(listed)
    assert len(set(listed)) == len(listed)
