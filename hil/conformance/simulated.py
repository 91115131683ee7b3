"""A talker with our own node and plant at the other end of the simulated wire, in lockstep."""

from pathlib import Path

from hil.bus.clock import Lockstep
from hil.bus.wire import Wire
from hil.conformance.eds import read_eds
from hil.conformance.talker import SAMPLE_CYCLES, Talker
from hil.lanes.lockstep import WirePort
from hil.node.amplifier import AmplifierNode
from hil.node.sense import Plant
from hil.node.wired import EDS, wired_node
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, load
from sim.config import Device, PlantConfig
from sim.plant import Plant as SimulatedPlant

_SEED = 1


def simulated_plant(bus: BusConfig) -> PlantOnBus:
    """The nominal plant of the reconstructed stage."""
    return PlantOnBus(
        SimulatedPlant(
            load("plants", "nominal", PlantConfig),
            load("stages", "reconstructed", Device),
            period_us=bus.period_us,
            seed=_SEED,
            drive_scale_v_per_count=bus.analog.drive_volt_per_count,
            sense_scale_f_per_count=bus.analog.sense_farad_per_count,
            sense_offset_f=bus.analog.sense_offset_f,
        )
    )


def simulated_talker(
    bus: BusConfig,
    eds: Path = EDS,
    *,
    allow_voltage: bool = False,
    plant: Plant | None = None,
    node_type: type[AmplifierNode] = AmplifierNode,
    sample_cycles: int = SAMPLE_CYCLES,
) -> Talker:
    """Node and wire as the bus configuration says, powered on. ``node_type``: a node with a defect, say."""
    if bus.can is None:
        raise ConfigError(f"bus {bus.name!r} has no [can]: there is no amplifier to talk to; take fd_5k or classic_2k")
    can = bus.can
    clock = Lockstep()
    wire = Wire(clock, can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s, _SEED)
    amplifier = wire.attach("amplifier")
    node = wired_node(can, clock, amplifier.send, plant or simulated_plant(bus), node_type)
    amplifier.on_frame = node.on_frame
    port = WirePort(wire.attach("tester"))
    node.power_on()
    variables = read_eds(eds, can.driver.node_id)
    return Talker(clock, port, bus, variables, allow_voltage=allow_voltage, sample_cycles=sample_cycles)
