"""Optimisation: a stage's targets, steps, loss terms, optimiser, density control and checkpoints."""
