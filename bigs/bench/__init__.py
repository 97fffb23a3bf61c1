"""Measuring: workloads, timed calls in processes of their own, errors, tables. Nothing here prints."""
