"""Clips as commands take them: opened, described, converted, and the truth beside them."""
