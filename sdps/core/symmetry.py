"""The eight ways to turn and mirror a scene about the view axis, and back: for training and for test-time augmentation.

Reflectance is isotropic, so a turned scene is one a camera could have seen, with its turned lights and normals. Every
function takes numpy arrays or torch tensors and returns the same kind.
"""

from typing import NamedTuple

from sdps.core.lighting import Array, library


class Symmetry(NamedTuple):
    """A mirror in x, if any, and quarter turns counter-clockwise after it."""

    turns: int = 0
    mirror: bool = False

    def images(self, images: Array, rows: int = -2) -> Array:
        """Turn images whose rows are dimension `rows`, and whose columns are the next."""
        xp, columns = library(images), rows + 1
        images = xp.flip(images, (columns,)) if self.mirror else images
        # Not by zero turns: that copies, out of the memory layout that networks are fast in.
        return xp.rot90(images, self.turns, (rows, columns)) if self.turns else images

    def vectors(self, vectors: Array, dim: int = -1) -> Array:
        """Turn vectors whose x, y and z lie along dimension `dim`."""
        xp = library(vectors)
        x, y, z = xp.moveaxis(vectors, dim, 0)
        x = -x if self.mirror else x
        for _ in range(self.turns % 4):
            x, y = -y, x
        return xp.stack([x, y, z], dim)

    def matrices(self, matrices: Array) -> Array:
        """Turn matrices (..., 3, 3) that map vectors to vectors."""
        return self.vectors(self.vectors(matrices, dim=-1), dim=-2)

    @property
    def back(self) -> "Symmetry":
        """What undoes it; a mirrored turn undoes itself."""
        return self if self.mirror else Symmetry(-self.turns % 4)


SYMMETRIES = tuple(Symmetry(turns, mirror) for turns in (0, 2, 1, 3) for mirror in (False, True))
"""The first 1, 2, 4 or 8 of them are a group each."""
