"""Reconstruction: one run, the demo's, series of runs, and runs without an ingredient."""
