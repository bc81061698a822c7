"""Commands on motions: `kinefit replay`, `export`, `retarget`, `simulate`, `evaluate`."""
