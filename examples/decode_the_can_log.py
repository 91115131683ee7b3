"""Decode the CAN log: python-can reads the frames of a run, cantools takes them apart into volts and farads."""

from pathlib import Path

import can
import cantools

import hil

hil.run("steps", lane="lockstep", out="steps")
database = cantools.database.load_file(hil.CONFIG_DIR / "comb_amplifier.dbc")
known = {message.frame_id for message in database.messages}
shown = set()
for frame in can.LogReader(Path("steps", "frames.log")):
    if frame.arbitration_id in known - shown:
        shown.add(frame.arbitration_id)
        message = database.get_message_by_frame_id(frame.arbitration_id)
        print(message.name, message.decode(bytes(frame.data), decode_choices=False))
