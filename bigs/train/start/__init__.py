"""Start values: smoothed estimates, the object's motion and surface, the scene."""
