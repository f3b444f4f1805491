"""From shards to training samples."""
