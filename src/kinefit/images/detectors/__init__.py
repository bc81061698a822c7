"""Detection and tracking of people in images: networks, regions of interest, skin colour."""
