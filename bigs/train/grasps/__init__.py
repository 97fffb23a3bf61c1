"""Grasps: the frames in which hands hold the object, and the object's size that follows."""
