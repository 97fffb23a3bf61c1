"""Many clips: the manifest, the engines that run it, and each job."""
