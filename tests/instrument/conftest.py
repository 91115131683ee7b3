"""Clients of Channel Access look on loopback alone; they read this when they are loaded."""

import os
import socket

with socket.socket() as found:
    found.bind(("127.0.0.1", 0))
    PORT = found.getsockname()[1]
os.environ |= {
    "EPICS_CA_ADDR_LIST": "127.0.0.1", "EPICS_CA_AUTO_ADDR_LIST": "NO", "EPICS_CA_SERVER_PORT": str(PORT),
    "EPICS_CAS_INTF_ADDR_LIST": "127.0.0.1", "OPHYD_CONTROL_LAYER": "caproto",
}  # fmt: skip
