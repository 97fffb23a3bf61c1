"""What no frame shows of the object: told apart from what was seen, and completed by symmetry or a prior."""
