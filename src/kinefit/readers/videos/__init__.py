"""Videos, the files they come in, and their sound."""
