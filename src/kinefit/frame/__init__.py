"""One time: what the sensors saw becomes measurements, is fitted, and judged."""
