"""Commands that train, compare and ship models."""
