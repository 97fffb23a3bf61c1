"""From a loaded clip to a fitted scene: start values, targets, stages, the loop and its checkpoints."""
