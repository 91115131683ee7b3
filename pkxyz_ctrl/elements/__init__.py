"""Flexures and combs, each by itself: stiffness, force and voltage of one element."""
