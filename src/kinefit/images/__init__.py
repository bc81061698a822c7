"""From pixels to measurements: people, their keypoints and their masks."""
