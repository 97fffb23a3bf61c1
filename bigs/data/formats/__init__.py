"""Formats of clips: HOLD's build folders, ARCTIC, HO-3D, and images with cameras of COLMAP or nerfstudio."""
