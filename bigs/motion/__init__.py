"""An object's motion from what its pictures show: features, tracks, their map, and its adjustment."""
