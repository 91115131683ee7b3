"""Amplifiers with one defect each."""
