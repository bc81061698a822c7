"""What other programs estimated, made right and improved."""
