"""What is known of a subject's markers."""
