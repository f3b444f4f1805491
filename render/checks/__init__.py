"""Checks of a data folder: every shard by itself, against its manifest line, and against the others."""
