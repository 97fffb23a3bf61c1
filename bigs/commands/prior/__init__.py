"""Priors for what no frame shows: learned words, small trained models, and loading of weights."""
