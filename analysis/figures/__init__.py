"""The figures, one file each, and the style that they share."""
