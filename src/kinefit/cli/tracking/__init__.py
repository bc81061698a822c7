"""Commands that track: `kinefit demo`, `track`, `live`, `batch`."""
