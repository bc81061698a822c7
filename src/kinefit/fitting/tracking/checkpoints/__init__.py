"""Results kept on the disk while a take is tracked, so that a later run resumes them."""
