"""Where the cameras stand: refined with the body, from people alone, from boards; and what is wrong with it."""
