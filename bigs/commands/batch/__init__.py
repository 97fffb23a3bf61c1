"""Many clips: the manifest, the engines that work on it, and each job."""
