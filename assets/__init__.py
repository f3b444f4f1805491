"""Data that travels with the package: presets, fitted materials and light sets (YAML)."""
