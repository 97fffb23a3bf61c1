"""Image, pose and shape scores, as the field's evaluators define them."""
