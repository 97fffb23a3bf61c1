"""Label images of each frame: from clicks, or from masks that another tool made."""
