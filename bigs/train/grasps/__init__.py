"""Where hands hold the object still, and how large that makes it."""
