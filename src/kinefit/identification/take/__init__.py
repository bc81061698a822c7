"""Who is who in a whole take."""
