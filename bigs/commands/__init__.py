"""What each command does, as functions: they return what there is to print and print nothing themselves."""
