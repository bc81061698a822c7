"""Files of keypoints, detections and annotations."""
