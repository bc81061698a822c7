"""Who is seen: size and shape of a person."""
