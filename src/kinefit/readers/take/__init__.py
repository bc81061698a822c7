"""Take files and everything that they name."""
