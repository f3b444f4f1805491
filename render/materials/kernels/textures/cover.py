"""A textured surface at points of the object: what its materials are there, and its normal with the relief."""

from typing import Any, NamedTuple

from render.backend.arrays import table
from render.backend.jit import dr, mi
from render.materials.kernels.textures import kinds, projections
from render.materials.kernels.textures.gloss import Appearance, Gloss
from render.materials.kernels.textures.jets import Jet, coordinates
from render.materials.textures import textured
from render.materials.textures.textured import UV, Textured
from render.shapes.geometry.mesh import TriangleMesh
from render.shared.errors import InputError
from render.shared.seeds import generator

_EDGE_ON = 0.05  # cosine to the viewer below which relief is turned towards it


class Place(NamedTuple):
    """Points of the object, in the object frame."""

    position: Any  # Vector3f (N), unit sphere
    normal: Any  # Vector3f (N), shading normal without relief
    prim: Any  # UInt32 (N), triangles
    corner: Any  # Point2f (N), barycentric coordinates of corners 1 and 2


class Cover:
    """A procedural pattern, as a material of its own or with other materials in its regions, or a folder of maps.

    Args:
        kind: One of `textured.KINDS`, or `maps`, or `uv`.
        seed: Of a procedural pattern.
        count: Materials laid into the regions; 0 for the texture's own.
        source: The folder's description; None for a procedural pattern.
        mesh: What is covered; only `uv` needs it.

    Raises:
        InputError: `uv` without a mesh that has texture coordinates.
    """

    def __init__(
        self, kind: str, seed: int, count: int = 0, source: Textured | None = None, mesh: TriangleMesh | None = None
    ) -> None:
        self.count = count
        self._pictures = self._unwrapped = None
        if kind == UV:
            if mesh is None or mesh.uv is None:
                raise InputError(f"material {source and source.name!r}: the mesh has no texture coordinates; use maps:")
            self._unwrapped = projections.Unwrapped(mesh)
        if source is not None and source.maps is not None:
            self._pictures = projections.Pictures(source.maps)
            self._repeats = table([source.repeats])
            return
        rng = generator(seed, "procedural", kind)
        self._numbers = kinds.Numbers(rng, getattr(kinds, f"draw_{kind}")(rng))
        self._flat = kind in kinds.FLAT
        self._laid = getattr(kinds, f"{'flat' if self._flat else 'solid'}_{kind}")
        self._palette = table(textured.palette(kind, seed))

    def at(self, place: Place, wi: Any) -> tuple[list, Any]:
        """Evaluate at points seen from `wi`, unevaluated.

        Args:
            place: N points.
            wi: Vector3f (N or 1), unit vectors to the viewer, object frame.

        Returns:
            Floats (N): the weights of the materials where there are any, else the values of `Gloss`; and the unit
            normals (N) with the relief.
        """
        if self._pictures is not None:
            look, slope = self._from_maps(place)
            values: Any = look
        else:
            values, slope = self._from_pattern(place)
        normal = turn(place.normal, slope, wi)
        if isinstance(values, Appearance):
            values = Gloss.prepare(values, dr.dot(normal, wi))
        return values, normal

    def slope(self, place: Place) -> Any:
        """Return the gradient of the height, Vector3f (N)."""
        return (self._from_maps if self._pictures is not None else self._from_pattern)(place)[1]

    def height(self, place: Place) -> Any:
        """Return the height of a procedural pattern, Float (N), in radii of the object."""
        return self._layers(place).height.value

    def _layers(self, place: Place) -> kinds.Layers:
        point = coordinates(place.position)
        if not self._flat:
            return self._laid(point, self._numbers)

        def one(side: int, u: int, v: int) -> list:
            found = self._laid(point[u], point[v], side, self._numbers)
            return [*found[:4], found.height.value, found.height.gradient]

        second, third, tone, wear, value, gradient = projections.from_three_sides(place.normal, one)
        return kinds.Layers(second, third, tone, wear, Jet(value, gradient))

    def _from_pattern(self, place: Place) -> tuple[Any, Any]:
        layers = self._layers(place)
        second, third = dr.clip(layers.second, 0, 1), dr.clip(layers.third, 0, 1)
        shares = [(1 - third) * (1 - second), (1 - third) * second, third]
        slope = layers.height.gradient
        if self.count:
            # Fewer materials than regions: the last regions start over with the first material.
            return [sum(shares[k :: self.count], mi.Float(0)) for k in range(self.count)], slope
        columns = [
            sum((share * dr.gather(mi.Float, self._palette, mi.UInt32(5 * k + c)) for k, share in enumerate(shares)),
                mi.Float(0))
            for c in range(5)
        ]  # fmt: skip
        base = mi.Color3f(*columns[:3]) * dr.maximum(layers.tone, 0)
        return Appearance(mi.Color3f(*(dr.clip(c, 0, 0.98) for c in base)), columns[3] + layers.wear, columns[4]), slope

    def _from_maps(self, place: Place) -> tuple[Appearance, Any]:
        pictures, repeats = self._pictures, dr.gather(mi.Float, self._repeats, mi.UInt32(0))
        assert pictures is not None  # by the caller
        if self._unwrapped is not None:
            across, up, *grow = self._unwrapped.at(place.prim, place.corner)
            found = pictures.at(across * repeats, up * repeats)
            tilt = grow[0] * found[5] + grow[1] * found[6] if pictures.relief else mi.Vector3f(0)
            return Appearance(mi.Color3f(*found[:3]), found[3], found[4]), tilt

        def one(side: int, u: int, v: int) -> list:
            found = pictures.at(place.position[u] * repeats, place.position[v] * repeats * pictures.aspect)
            slope = mi.Vector3f(0)
            if pictures.relief:
                slope[u], slope[v] = found[5], found[6]
            return [*found[:5], slope]

        red, green, blue, rough, metal, slope = projections.from_three_sides(place.normal, one)
        return Appearance(mi.Color3f(red, green, blue), rough, metal), slope


def turn(normal: Any, slope: Any, wi: Any) -> Any:
    """Return the normals of a surface with relief, n - (g - (g.n) n) normalised (Blinn 1978).

    A facet that would turn away from the viewer is hidden behind others in the world; it is turned until it is seen
    nearly edge-on. Where the surface itself faces away, the normal stays.

    Args:
        normal: (N) unit normals of the surface.
        slope: (N) gradients of the height, in the same frame.
        wi: (N or 1) unit vectors to the viewer.
    """
    moved = dr.normalize(normal - (slope - dr.dot(slope, normal) * normal))
    plain, cosine = dr.dot(normal, wi), dr.dot(moved, wi)
    lacking = dr.maximum(dr.minimum(plain, _EDGE_ON) - cosine, 0)
    return dr.select(plain > 0, dr.normalize(moved + lacking * wi), normal)


def of_texture(source: Textured, mesh: TriangleMesh | None = None) -> Cover:
    """Return the cover of a textured material on a mesh."""
    return Cover(source.kind, source.seed, source=source, mesh=mesh)
