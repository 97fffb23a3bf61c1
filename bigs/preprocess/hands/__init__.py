"""Hand tracks: fitted to keypoints, or from other estimators' files."""
