"""Programs that a test stops as a user does."""

# Who starts the tests in the background of a shell may have them, and their children, ignore Ctrl-C.
STOPPABLE = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
