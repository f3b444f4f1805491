"""What becomes of rendered radiance without rendering again: cameras that record it, and light mixed from lights."""
