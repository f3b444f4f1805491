"""Chrome and white balls in pictures, and the lights they give."""
