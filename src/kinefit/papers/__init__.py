"""Published methods, each in a short file, built from the library's parts."""
