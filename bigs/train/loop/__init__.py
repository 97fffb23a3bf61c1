"""Optimisation: what a stage looks at, its steps, loss terms, optimiser, density control and checkpoints."""
