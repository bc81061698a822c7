"""Images to measurements: detected people, keypoints, masks, depth points."""
