"""Priors for what no frame shows: words taught, small models trained, weights found."""
