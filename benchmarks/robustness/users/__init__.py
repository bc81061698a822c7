"""Files and commands as users have them."""
