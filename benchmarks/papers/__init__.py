"""The published methods, each on its own kind of data, and the rows of docs/papers.md."""
