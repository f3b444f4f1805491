"""Commands that render: training data, test scenes, catalogues of shapes and materials."""
