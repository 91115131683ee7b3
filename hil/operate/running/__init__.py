"""A stage in operation at the machine's clock: by Python's loop, or by the native one."""
