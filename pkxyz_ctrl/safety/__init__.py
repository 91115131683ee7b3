"""What stands between the control law and the combs: modes, monitors, the transmit gate.

Pure, and independent of the law: nothing here imports the core, reads a clock or touches a bus.
"""
