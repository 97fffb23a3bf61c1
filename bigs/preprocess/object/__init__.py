"""The object's motion and points from its masked pixels."""
