"""Conformance of an amplifier, anyone's: may this CANopen node be enabled? Checks that talk frames over any port."""
