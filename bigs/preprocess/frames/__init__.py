"""Pictures of a source become numbered frames with a camera."""
