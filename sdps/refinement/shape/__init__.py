"""The surface that normals belong to: which pixels are neighbours, how light travels over it."""
