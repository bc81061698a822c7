"""Kinds of sensors of a take file, one file each: entry, reading, sensor; `readers.take.kinds` lists them."""
