"""What no frame shows of the object, and its completion by symmetry or a prior."""
