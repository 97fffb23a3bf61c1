"""Rotations, rigid transforms, meshes and surfaces: plain functions, no state."""
