"""The tables of fault and emergency codes for the troubleshooting page: text, what to check, what clears it."""

from hil.screen.fault_codes import EMERGENCY_CAUSES, stem, trips
from pkxyz_ctrl.can import emergency
from pkxyz_ctrl.safety.trips import LANDS, STOPS, Trip


def trips_table() -> str:
    """Every fault code with an anchor of its name."""
    lines = [
        "| code | what a person reads | usual cause, what to check | what clears it |",
        "| --- | --- | --- | --- |",
    ]
    for name, happened, cause, clears in trips().values():
        lines.append(f'| <a id="{name.lower()}"></a>{name} | {happened} | {cause} | {clears} |')
    return "\n".join(lines)


def stops_table() -> str:
    """How each fault stops, and why; faults with one reason in a line."""
    lines = ["| fault | combs | why |", "| --- | --- | --- |"]
    lands = {stem(trip.name or "") for trip in Trip if trip & LANDS}
    for name, why in sorted(STOPS.items(), key=lambda item: item[0] not in lands):
        lines.append(f"| {name} | {'led down, then 0 V' if name in lands else '0 V at once'} | {why} |")
    return "\n".join(lines)


def emergencies_table() -> str:
    """Every emergency code that has a text of its own, then the classes."""
    lines = ["| code | meaning | usual cause | what ends it |", "| --- | --- | --- | --- |"]
    for code, text in emergency._EXACT.items():
        cause, ends = EMERGENCY_CAUSES.get(code, ("see the text", "the next good drive PDO"))
        lines.append(f'| <a id="{code:04x}"></a>0x{code:04X} | {text} | {cause} | {ends} |')
    for high, text in emergency._CLASS.items():
        lines.append(f"| 0x{high:02X}xx | {text} | the amplifier's manual | an EMCY 0x0000 |")
    return "\n".join(lines)
