"""The configuration of a run: its values, presets, ranges and file."""
