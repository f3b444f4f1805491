"""Processes that render a plan into shards, or into a stream."""
