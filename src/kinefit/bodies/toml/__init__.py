"""Bodies in TOML: records, closures, couplings."""
