"""What each command does, as functions that return what the command line prints."""
