"""What a person looks at: the window, live takes, viewers, and the server of their pages."""
