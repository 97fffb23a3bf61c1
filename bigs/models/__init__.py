"""The scene as modules: one canonical hand for both sides, one canonical object, and every frame's poses."""
