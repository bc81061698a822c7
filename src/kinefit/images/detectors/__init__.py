"""Detection of people in images: networks, regions of interest, people over time, skin."""
