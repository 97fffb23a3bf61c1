"""What is odd about a clip as it comes: found, told, and taken out or allowed for."""
