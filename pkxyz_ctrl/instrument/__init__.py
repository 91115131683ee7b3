"""What other laboratory software knows a stage by: EPICS motor records, SCPI, bluesky devices. Thin over the client."""
