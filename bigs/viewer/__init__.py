"""Results to look at: preview pictures, a video, an offline report and the live viewer."""
