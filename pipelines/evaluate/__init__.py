"""Commands that score methods on rendered scenes, and what they share."""
