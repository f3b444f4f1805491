"""Picture files: of which kind they are, how each kind is decoded, and which of a folder's files are photographs."""
