"""The folder of a run: its files, who writes it, and what it was made from."""
