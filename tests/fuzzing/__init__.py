"""Damaged files of every kind, put before the real command line: see docs/stability.md.

`python -m tests.fuzzing` runs the cases; each has a target and a number and can be repeated by them.
"""
