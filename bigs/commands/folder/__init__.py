"""The folder of a run: what lies where, who writes it, and what it was made from."""
