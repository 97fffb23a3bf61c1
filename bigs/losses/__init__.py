"""Losses as small pure functions on tensors: no model, no dataset, no configuration.

`bigs.fused.pixels` evaluates those of single pixels in one pass; tests hold it to the functions here.
"""
