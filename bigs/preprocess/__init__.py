"""From an ordinary video to a clip: frames, masks, hands, the object's motion, alignment, build folder."""
