"""Several cameras together: people, left and right, noise."""
