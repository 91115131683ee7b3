"""The exported controller on an emulated Cortex-M7, in lockstep with bus, amplifier and plant."""
