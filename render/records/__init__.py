"""What is on disk: the manifest of a plan, the EXR shard, the ledger of runs."""
