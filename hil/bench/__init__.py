"""Measurements of speed and accuracy, one function each. ``hil.bench.suite`` runs them, ``pkxyz bench`` prints them."""
