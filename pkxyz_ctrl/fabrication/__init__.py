"""From a process with its spread to the devices of a wafer: what each was made into, and its mechanics, in batches."""
