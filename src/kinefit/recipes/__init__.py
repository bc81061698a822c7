"""Published methods, each short, over the parts of the library."""
