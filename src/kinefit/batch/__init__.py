"""Takes to folders of results: one, many on one machine, many on a cluster; and what a whole study shows."""
