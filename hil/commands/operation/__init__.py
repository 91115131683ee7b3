"""Commands about a stage in operation."""
