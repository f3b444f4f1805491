"""The surfaces of a view in Dr.Jit arrays: what the renderer samples and evaluates.

Materials of one kind are packed into a family (`PackedMaterials` for fitted ones, `PackedMerl` for MERL tables,
`PackedRgl` for RGL files), whose kernels take the material's number as data.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from render.backend.arrays import opaque
from render.backend.jit import dr, mi
from render.materials import surfaces as surface_names
from render.materials.kernels.bsdf import PackedMaterials
from render.materials.kernels.patterns import Evaluator
from render.materials.kernels.textures import cover
from render.materials.kernels.textures.cover import Cover, Place
from render.materials.kernels.textures.gloss import Gloss
from render.materials.model import Material
from render.materials.surfaces import Surface
from render.materials.textures.textured import Textured
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.errors import InputError

GLOSSY = 0.1
"""Share of light in a narrow highlight from which on it gets samples of its own (`render.kernel.highlights`)."""


class Part(NamedTuple):
    """One material of a surface: its family's number and its own in the family."""

    family: int
    member: int


class PackedSurfaces:
    """The surfaces that share the rays of a view.

    Args:
        surfaces: At least one surface.
        mesh: The object they cover; only patterns that follow its pieces need it.

    Raises:
        InputError: no surface given.

    Attributes:
        names: Names of the surfaces.
        families: The packed families.
        parts: Per surface, its materials.
        glossy: Per surface, whether a narrow highlight reflects more than the share `GLOSSY` of some material's light;
            never with a relief, which spreads it.
        covers: Per surface, its texture, or None.
    """

    def __init__(self, surfaces: Sequence[Surface], mesh: TriangleMesh | None = None) -> None:
        if not surfaces:
            raise InputError("materials: at least one is needed")
        self.names = tuple(surface.name for surface in surfaces)
        plain = [() if isinstance(surface.components[0], Textured) else surface.components for surface in surfaces]
        self.families, places = _pack([component for components in plain for component in components])
        numbers = iter(places)
        self.parts = tuple(tuple(next(numbers) for _ in components) for components in plain)
        self.covers = tuple(cover_of(surface, mesh) for surface in surfaces)
        self._patterns = [
            surface.pattern and not surface.textured and Evaluator(surface.pattern, mesh) for surface in surfaces
        ]
        narrow = [family.highlight for family in self.families]
        self.glossy = tuple(
            not over and any(narrow[part.family][part.member] > GLOSSY for part in parts)
            for over, parts in zip(self.covers, self.parts, strict=True)
        )

    def __len__(self) -> int:
        return len(self.parts)

    def weights(self, position: "mi.Point3f", prim: "mi.UInt32") -> tuple:
        """Return per surface the Float weights (N) of its materials at points, or None for one alone or textured."""
        return tuple(pattern.weights(position, prim) if pattern else None for pattern in self._patterns)

    def at(self, place: Place, wi: Any) -> tuple[tuple, tuple]:
        """Return what evaluation needs of points of the object.

        Args:
            place: N points.
            wi: Vector3f (N or 1), unit vectors to the viewer, object frame.

        Returns:
            Per surface its `weights`, for a texture of its own the values of `Gloss`; and per surface its normals (N)
            where a texture turns them, or None.
        """
        weights, normals = list(self.weights(place.position, place.prim)), [None] * len(self)
        for number, over in enumerate(self.covers):
            if over is not None:
                values, normals[number] = over.at(place, wi)
                weights[number] = values if len(values) > 1 else None
                dr.eval(values, normals[number])
        return tuple(weights), tuple(normals)

    def shares(self, number: int) -> bool:
        """Return whether the weights of a surface are the shares of its materials."""
        return len(self.parts[number]) > 1

    def eval(self, number: int, wi: Any, wo: Any, weights: tuple | None, active: Any = True) -> "mi.Color3f":
        """Evaluate f cos(theta_o) of surface `number`.

        Args:
            number: Number of the surface.
            wi: (N) unit vectors to the viewer, local frame.
            wo: (N) unit vectors to the light, local frame.
            weights: The entry of `weights` for this surface at these lanes.
            active: Lanes to evaluate.
        """
        if not self.parts[number]:
            return Gloss(weights).eval(None, wi, wo, active)
        total, prepared = mi.Color3f(0), {}
        for k, part in enumerate(self.parts[number]):
            family = self.families[part.family]
            if part.family not in prepared:
                prepared[part.family] = family.prepare(wi, wo, active)
            value = family.eval_at(opaque(mi.UInt32(part.member)), prepared[part.family])
            total += value if weights is None else value * weights[k]
        return total

    def sample(
        self, weights: tuple, wi: Any, chosen: Any, lobe: Any, point: Any, numbers: Sequence[int] | None = None
    ) -> tuple:
        """Draw directions from the mixture of the lobes of all materials, in equal shares by surface.

        The density is that of the whole mixture (one-sample balance heuristic, Veach 1997, eq. 9.15), so that each
        surface's image has the expectation it would have alone.

        Args:
            weights: As returned by `weights`, at these lanes.
            wi: (N) unit vectors to the viewer, local frame.
            chosen: (N) uniform variates that choose the material.
            lobe: (N) uniform variates that choose its lobe.
            point: (N) Point2f variates that choose the direction.
            numbers: Surfaces to draw for, all by default.

        Returns:
            wo (N) in the local frame and its density per solid angle (N).
        """
        wo = self.draw(weights, wi, chosen, lobe, point, numbers)
        dr.eval(wo)
        return wo, self.density(weights, wi, wo, numbers)

    def draw(
        self, weights: tuple, wi: Any, chosen: Any, lobe: Any, point: Any, numbers: Sequence[int] | None = None
    ) -> Any:
        """Draw the directions of `sample`, unevaluated; surfaces with a normal of their own are drawn for alone."""
        numbers = range(len(self)) if numbers is None else numbers
        if not self.parts[numbers[0]]:
            return Gloss(weights[numbers[0]]).sample_lobe(None, wi, lobe, point)
        lanes = dr.width(chosen)
        shares = [self._shares(number, weights, lanes, numbers) for number in range(len(self.families))]
        wo, reached = mi.Vector3f(0, 0, 1), mi.Float(0)

        def walk(k: Any, weight: Any, edge: Any, index: Any, mine: Any) -> tuple:
            hit = (chosen >= edge) & (weight > 0)
            return edge + weight, dr.select(hit, k, index), mine | hit

        for family, share in zip(self.families, shares, strict=True):
            state = (mi.Float(reached), mi.UInt32(0), mi.Bool(False))
            reached, index, mine = _over_materials(len(family), share, lanes, state, walk)
            wo = dr.select(mine, family.sample_lobe(index, wi, lobe, point, mine), wo)
        return wo

    def density(self, weights: tuple, wi: Any, wo: Any, numbers: Sequence[int] | None = None) -> Any:
        """Return the density, Float (N) per solid angle, with which `draw` gives evaluated directions."""
        numbers = range(len(self)) if numbers is None else numbers
        if not self.parts[numbers[0]]:
            return Gloss(weights[numbers[0]]).pdf(None, wi, wo)
        lanes = dr.width(wo)
        shares = [self._shares(number, weights, lanes, numbers) for number in range(len(self.families))]
        density = mi.Float(0)
        for family, share in zip(self.families, shares, strict=True):

            def add(k: Any, weight: Any, total: Any, family: Any = family) -> tuple:
                return (dr.fma(weight, family.pdf(k, wi, wo), total),)

            (density,) = _over_materials(len(family), share, lanes, (density,), add)
        return density

    def _shares(self, family: int, weights: tuple, lanes: int, numbers: Sequence[int]) -> tuple:
        """Return the share of each material of a family in the mixture, (K) or, where patterns vary, (K * lanes)."""
        count, fraction = len(self.families[family]), 1 / len(numbers)
        fixed = np.zeros(count)
        varying: dict[int, Any] = {}
        for number in numbers:
            weight = weights[number]
            for k, part in enumerate(self.parts[number]):
                if part.family != family:
                    continue
                if weight is None:
                    fixed[part.member] += fraction
                else:
                    varying[part.member] = varying.get(part.member, mi.Float(0)) + fraction * weight[k]
        if not varying:
            return opaque(mi.Float(fixed.astype(np.float32))), False
        flat = dr.zeros(mi.Float, count * lanes)
        lane = dr.arange(mi.UInt32, lanes)
        for index in range(count):
            share = varying.get(index, mi.Float(0)) + opaque(mi.Float(float(fixed[index])))
            dr.scatter(flat, share, lane + opaque(mi.UInt32(index * lanes)))
        dr.eval(flat)
        return flat, True


def _over_materials(count: int, share: tuple, lanes: int, state: tuple, step: Any) -> tuple:
    """Loop over the materials of a family: `state = step(k, weight, *state)`, the weight from `_shares`."""
    weights, varies = share
    total, lane = opaque(mi.UInt32(count)), dr.arange(mi.UInt32, lanes)
    width = opaque(mi.UInt32(lanes if varies else 1))

    def body(k: Any, *values: Any) -> tuple:
        return k + 1, *step(k, dr.gather(mi.Float, weights, dr.fma(k, width, lane) if varies else k), *values)

    _, *last = dr.while_loop((mi.UInt32(0), *state), lambda k, *_: k < total, body)
    return tuple(last)


def cover_of(surface: Surface, mesh: TriangleMesh | None = None) -> Cover | None:
    """Return the texture of a surface on a mesh."""
    first = surface.components[0]
    if isinstance(first, Textured):
        return cover.of_texture(first, mesh)
    pattern = surface.pattern
    return Cover(pattern.texture, pattern.seed, pattern.count) if pattern and pattern.texture else None


def pack(names: Sequence[str], mesh: TriangleMesh | None = None) -> PackedSurfaces:
    """Load surfaces by name (see `render.materials.surfaces.load`) and pack them.

    Raises:
        InputError: an unknown name or a file that cannot be read.
    """
    return PackedSurfaces([surface_names.load(name) for name in names], mesh)


def _pack(components: list) -> tuple[tuple, list[Part]]:
    """Sort materials into families, each material once; return the families and the place of every component."""
    kinds: dict[type, dict[int, Any]] = {}
    for component in components:
        kinds.setdefault(type(component), {}).setdefault(id(component), component)
    order = list(kinds)
    families = tuple(_family(kind, list(kinds[kind].values())) for kind in order)
    places = []
    for component in components:
        members = kinds[type(component)]
        places.append(Part(order.index(type(component)), list(members).index(id(component))))
    return families, places


def _family(kind: type, members: list) -> Any:
    """Pack the materials of one kind; the rarer kinds are imported only where they are used."""
    if kind is Material:
        return PackedMaterials(members)
    if kind.__name__ == "MerlTable":
        from render.materials.kernels.merl_bsdf import PackedMerl

        return PackedMerl(members)
    from render.materials.kernels.rgl_bsdf import PackedRgl

    return PackedRgl(members)
