"""The amplifier as the controller meets it: a CiA 301 device with the analogue part of CiA 401."""
