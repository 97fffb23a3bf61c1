"""Moves: the frames between grasps, in which nothing but its own picture tells a hand's pose."""
