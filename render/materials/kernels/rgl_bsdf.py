"""RGL materials inside Dr.Jit kernels, through Mitsuba's own `measured` plugin: one instance per file.

Importing this module loads mitsuba. The files are described at `render.materials.rgl`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from render.backend.jit import dr, mi
from render.materials import highlight, model
from render.materials.rgl import RglMaterial
from render.shared.errors import InputError

_HALF_ANGLES = np.radians(np.concatenate([[0.0], np.geomspace(0.02, 4, 60), np.linspace(4.5, 80, 152)]))


class Directions(NamedTuple):
    """What evaluation needs of a pair of directions; `measured` has no part that files could share."""

    wi: Any  # Vector3f, to the camera
    wo: Any  # Vector3f, to the light
    active: Any  # Bool


class PackedRgl:
    """K `.bsdf` files for kernels that index them by number; a packed family like `PackedMaterials`.

    An index selects among the plugin instances by `dr.switch`. Their tables are data to the kernel and instances of
    equal table sizes share one piece of code, so exchanging such files, or their number, seldom compiles anything:
    Mitsuba 3.9 leaves `m_reduction` of isotropic files unset, so a file has, by chance, one of three pieces of code,
    which differ in signs that do not matter to it.

    Args:
        materials: At least one file.

    Raises:
        InputError: no material given, or a file that Mitsuba refuses.
    """

    def __init__(self, materials: Sequence[RglMaterial]) -> None:
        if not materials:
            raise InputError("materials: at least one is needed")
        self.names = tuple(material.name for material in materials)
        self._plugins = [_plugin(material) for material in materials]
        self._context = mi.BSDFContext()
        self.highlight = np.array([self._highlight(number) for number in range(len(self))])

    def __len__(self) -> int:
        return len(self.names)

    @staticmethod
    def prepare(wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True) -> Directions:
        """Return the directions themselves, in the form `eval_at` takes."""
        return Directions(wi, wo, mi.Bool(active))

    def eval_at(self, index: "mi.UInt32", at: Directions) -> "mi.Color3f":
        """Evaluate f cos(theta_o) of the materials `index` at prepared directions."""
        return self.eval(index, at.wi, at.wo, at.active)

    def eval(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """Evaluate f cos(theta_o), zero where either direction is below the horizon.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera (or the previous vertex), local shading frame.
            wo: Unit vectors to the light, which carries the cosine.
            active: Lanes to evaluate.
        """

        def one(plugin: Any, wi: Any, wo: Any, active: Any) -> Any:
            return mi.Color3f(plugin.eval(self._context, _interaction(wi), wo, active))

        return self._switch(index, one, wi, wo, mi.Bool(active))

    def sample_lobe(
        self,
        index: "mi.UInt32",
        wi: "mi.Vector3f",
        sample1: "mi.Float",
        sample2: "mi.Point2f",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Vector3f":
        """Draw `wo` as the plugin does, from the file's luminance; below the horizon `eval` and `pdf` are zero.

        Args:
            index: Material numbers.
            wi: Unit vectors to the camera.
            sample1: Not used.
            sample2: Two uniform variates.
            active: Lanes to sample.
        """

        def one(plugin: Any, wi: Any, sample2: Any, active: Any) -> Any:
            return mi.Vector3f(plugin.sample(self._context, _interaction(wi), 0, sample2, active)[0].wo)

        return self._switch(index, one, wi, mi.Point2f(sample2), mi.Bool(active))

    def pdf(
        self, index: "mi.UInt32", wi: "mi.Vector3f", wo: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.Float":
        """Return the density per solid angle with which `sample_lobe` draws `wo`; zero below the horizon."""

        def one(plugin: Any, wi: Any, wo: Any, active: Any) -> Any:
            return plugin.pdf(self._context, _interaction(wi), wo, active)

        return self._switch(index, one, wi, wo, mi.Bool(active))

    def _switch(self, index: Any, one: Callable, *arguments: Any) -> Any:
        """Apply `one` to the plugin that each lane's index selects."""
        if len(self) == 1:
            return one(self._plugins[0], *arguments)
        targets = [lambda *values, plugin=plugin: one(plugin, *values) for plugin in self._plugins]
        return dr.switch(mi.UInt32(index), targets, *arguments)

    def _highlight(self, number: int) -> float:
        """Return `highlight.share` of the back-scattering f(w, w), for which theta_h is the angle of w."""
        direction = mi.Vector3f(
            mi.Float(np.sin(_HALF_ANGLES).astype(np.float32)), 0, mi.Float(np.cos(_HALF_ANGLES).astype(np.float32))
        )
        value = np.array(self._plugins[number].eval(self._context, _interaction(direction), direction, True))
        return float(highlight.share(_HALF_ANGLES, model.LUMINANCE @ value / np.cos(_HALF_ANGLES)))


def _plugin(material: RglMaterial) -> "mi.BSDF":
    try:
        return mi.load_dict({"type": "measured", "filename": str(material.path)})
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputError(f"{material.path}: Mitsuba cannot read it ({reason}); download the file again") from error


def _interaction(wi: "mi.Vector3f") -> "mi.SurfaceInteraction3f":
    """Return an interaction that holds nothing but the direction to the camera, in the local frame."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi = wi
    return si
