"""`sdps data`: plan, check, preview, describe, export and import data folders."""
