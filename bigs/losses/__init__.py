"""Losses as small pure functions on tensors: no model, no dataset, no configuration."""
