"""From normals to what people want: depth, a mesh, and the object under other lights."""
