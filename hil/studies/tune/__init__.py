"""Searches for the weights of a law."""
