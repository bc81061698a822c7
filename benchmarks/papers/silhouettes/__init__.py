"""P1: silhouettes, morphing surfaces, free-form contours."""
