"""Sensitivities, margins, and the changed plants over which they have to hold."""
