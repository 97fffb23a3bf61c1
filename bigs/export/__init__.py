"""Results as files that other programs read: splat PLY, challenge predictions, poses, meshes."""
