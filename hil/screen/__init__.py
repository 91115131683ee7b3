"""What the commands share at the terminal: choices, outputs, progress, tables, errors in a line."""
