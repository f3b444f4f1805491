"""Triangle meshes, signed distance fields, and the way from one to the other."""
