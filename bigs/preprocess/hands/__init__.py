"""Hand tracks: from keypoints by a fit, or from what other estimators leave."""
