"""What other programs want of a saved result: files in their forms, frames and units."""
