"""Seeds of region growing, found without help."""
