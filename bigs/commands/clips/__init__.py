"""Clips for commands: opened, described, converted, and their ground truth."""
