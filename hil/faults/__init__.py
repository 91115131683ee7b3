"""Faults as data: what may go wrong, where, when and how badly, and what then has to happen."""
