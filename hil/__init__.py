"""The harness: simulated bus, amplifier node, lanes, scenarios, recordings, reports and the command line."""
