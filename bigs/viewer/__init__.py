"""Results for a person to look at: preview pictures, a video, and a report that opens offline."""
