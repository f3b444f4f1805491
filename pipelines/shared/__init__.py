"""What commands share: presets, flags, pictures, charts, text tables, test scenes."""
