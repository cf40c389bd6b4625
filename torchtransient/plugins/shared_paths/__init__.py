"""Light that the paths of neighbouring pixels share."""
