"""The client of a stage in operation, for programs. Knows neither the controller nor the harness."""
