"""Which scenes a data folder is to hold."""

from dataclasses import dataclass, field

from render.materials.surfaces import MOST_COMPONENTS, PATTERNS
from render.planning import light_sets
from render.planning.mesh_family import MeshFamily
from render.records.manifest import COMPOSITION, OWN_MESHES
from render.shared.config import check_fields
from render.shared.errors import InputError, unknown
from render.shared.files import is_plain_name

UPRIGHT = ("sculpture", "bunny", COMPOSITION)  # families that stand; others have no up
LARGEST_SCALE = 10.0  # of a view
PERSPECTIVE = "perspective"
MIXED = "mixed"  # each view one of the two
CAMERAS = ("orthographic", PERSPECTIVE, MIXED)


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Which scenes to render.

    Attributes:
        seed: Root seed; 0 is a seed like any other.
        prefix: Put before the name of every scene, which is family and number otherwise: so folders of several seeds
            or presets join without meeting a name twice.
        families: Seeded shape families, or `meshes`, and how many shapes of each.
        meshes: Mesh files that are the family `meshes`: each once in a seeded order, then again in other poses. Whole
            files are kept for validation, so that none is in both splits.
        views: Random views per shape.
        materials_per_view: Different random materials per view (each is a sample of its own; they share rays).
        materials: Names, categories, or `all`; `lambertian:<albedo>`, material files and folders of maps are allowed;
            `procedural` and `procedural:<kind>` are drawn again for every scene.
        material_weights: How often a material is drawn relative to the others, which count 1, by name or category; of
            a material that both name, the name counts.
        validation_materials: Materials, as in `materials`, that every second validation scene has in place of its own,
            on all of its surface; `held-out` are those the package keeps for this. Empty: none.
        spatially_varying: Share of the scenes whose surface mixes materials in a pattern, in [0, 1]. Such a scene
            keeps the material it would have had alone as its first one.
        patterns: Patterns to draw from: patches, stripes, noise, gradient, parts.
        mixture: Fewest and most materials of a mixed surface.
        validation: Share of the shapes of each family kept for validation, in [0, 0.5], at least one when above 0.
            Raising a count moves no shape from one split to the other.
        lights: Distribution of the light directions, drawn again for each view.
        light_count: Lights per view.
        near_lights: Share of the views, in [0, 1], whose lights are near: points at distances drawn from
            `near_light_distance`, in the directions that `lights` gives from the object's centre, where their
            irradiance is pi.
        near_light_distance: Range of these distances, in half image widths, drawn uniformly in 1 / distance; the upper
            end may be `.inf`.
        near_light_spread: The lights of a view stand about equally far: their distances have one of that range in
            common, and factors whose logarithms have a standard deviation of up to this, drawn for each view, as
            lamps held by hand do. None: each distance is drawn by itself.
        camera: `orthographic` or `perspective` for all views, or `mixed`: half of the views each, drawn at random.
        camera_distance: Range of the distance of a perspective camera from the plane of the object's centre, in half
            image widths, drawn as that of lights, but never below 1.5 of the object's radius. The field of view is
            2 atan(1 / distance): 28 to 11 degrees.
        size: Image side in pixels, a multiple of 4.
        spp: Camera samples per pixel; more did not make trained networks better (docs/studies/renderer.md).
        bounces: Interreflection bounces.
        composition_bounces: The same for compositions, whose objects light each other.
        composition_materials: Fewest and most materials of a composition, each on objects of its own; from 1 to 8.
        scale: Range of the radius of the bounding sphere of blobs, in half image widths.
        upright_scale: The same for standing shapes, which fill less of their bounding sphere.
        offset: Largest image-plane offset of the object, in half image widths, per unit of scale above 0.5.
        tiles: Standing shapes are framed in an image of tiles x tiles frames (whose half width `upright_scale` counts
            in), and one of these tiles, drawn at random, is the view. The published recipe has 4.
        min_foreground: Least share of the frame the shape must cover, by family; other views are drawn again.
        min_normal_spread: Least degrees between the normals of a view and their mean (`render.planning.framing`), by
            family; views of flat facets are drawn again.
    """

    seed: int = 0
    prefix: str = ""
    families: dict[str, int] = field(default_factory=lambda: {"blobby": 8, "sculpture": 8})
    meshes: MeshFamily | None = None
    views: int = 2
    materials_per_view: int = 2
    materials: tuple[str, ...] = ("all",)
    material_weights: dict[str, float] = field(default_factory=dict)
    validation_materials: tuple[str, ...] = ()
    spatially_varying: float = 0.0
    patterns: tuple[str, ...] = tuple(PATTERNS)
    mixture: tuple[int, int] = (2, 3)
    validation: float = 0.05
    lights: str = "azimuth-elevation"
    light_count: int = 64
    near_lights: float = 0.0
    near_light_distance: tuple[float, float] = (2.5, 6.0)
    near_light_spread: float | None = None
    camera: str = "orthographic"
    camera_distance: tuple[float, float] = (4.0, 10.0)
    size: int = 128
    spp: int = 16
    bounces: int = 2
    composition_bounces: int = 3
    composition_materials: tuple[int, int] = (2, 5)
    scale: tuple[float, float] = (0.75, 1.25)
    upright_scale: tuple[float, float] = (0.95, 2.0)
    offset: float = 0.25
    tiles: int = 1
    min_foreground: dict[str, float] = field(default_factory=dict)
    min_normal_spread: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", "views", "materials_per_view", "light_count", "spp", "tiles")
        check_fields(self, "not negative", "seed")
        if self.prefix and not is_plain_name(self.prefix):
            raise InputError(f"prefix: {self.prefix!r} cannot name a file; use letters, digits, '-', '_' and '.'")
        if self.size < 16 or self.size % 4:
            raise InputError(f"size must be a multiple of 4 from 16 up, got {self.size}")
        for name in ("bounces", "composition_bounces"):
            if not 0 <= getattr(self, name) <= 16:
                raise InputError(f"{name} must be in 0..16, got {getattr(self, name)}")
        if not 0 <= self.validation <= 0.5:
            raise InputError(f"validation must be in [0, 0.5], got {self.validation}")
        if self.lights not in light_sets.DISTRIBUTIONS:
            raise unknown("value for lights:", self.lights, light_sets.DISTRIBUTIONS)
        for name in ("scale", "upright_scale"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(f"{name} must be two rising positive numbers, got {low}, {high}")
        if not self.families or min(self.families.values()) < 0:
            raise InputError("families must name at least one shape family with a count of 0 or more")
        if (self.meshes is None) == (OWN_MESHES in self.families):
            raise InputError(
                "families.meshes and meshes belong together: how many shapes, and where their files are "
                "(families: {meshes: 20}, meshes: {path: FOLDER})"
            )
        self._check_surfaces()
        self._check_framing()
        self._check_distances()

    def _check_surfaces(self) -> None:
        if not 0 <= self.spatially_varying <= 1:
            raise InputError(f"spatially_varying must be in [0, 1], got {self.spatially_varying}")
        low, high = self.mixture
        if not 2 <= low <= high <= MOST_COMPONENTS:
            raise InputError(f"mixture must be two rising numbers in 2..{MOST_COMPONENTS}, got {low}, {high}")
        low, high = self.composition_materials
        if not 1 <= low <= high <= MOST_COMPONENTS:
            raise InputError(
                f"composition_materials must be two rising numbers in 1..{MOST_COMPONENTS}, got {low}, {high}"
            )
        for name, weight in self.material_weights.items():
            if not 0 <= weight <= 100:
                raise InputError(f"material_weights.{name} must be in [0, 100], got {weight}")
        if not self.patterns:
            raise InputError(f"patterns must name at least one of {', '.join(PATTERNS)}")
        for name in self.patterns:
            if name not in PATTERNS:
                raise unknown("value for patterns:", name, PATTERNS)

    def _check_framing(self) -> None:
        if self.tiles * self.upright_scale[1] > LARGEST_SCALE:
            raise InputError(
                f"tiles x upright_scale must not exceed {LARGEST_SCALE:g}, got {self.tiles} x {self.upright_scale[1]}"
            )
        for name, limit in (("min_foreground", 0.9), ("min_normal_spread", 30.0)):
            for family, value in getattr(self, name).items():
                if family not in self.families:
                    raise unknown(f"family in {name}:", family, self.families)
                if not 0 <= value <= limit:
                    raise InputError(f"{name}.{family} must be in [0, {limit:g}], got {value}")

    def _check_distances(self) -> None:
        if not 0 <= self.near_lights <= 1:
            raise InputError(f"near_lights must be in [0, 1], got {self.near_lights}")
        if self.camera not in CAMERAS:
            raise unknown("value for camera:", self.camera, CAMERAS)
        if self.camera != "orthographic" and self.tiles > 1:
            raise InputError("tiles: parts of an image need camera: orthographic; set tiles to 1")
        sizes = {family: (self.upright_scale if self.stands(family) else self.scale)[1] for family in self.families}
        largest = max(size * self.tiles_of(family) for family, size in sizes.items())
        for name in ("near_light_distance", "camera_distance"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(f"{name} must be two rising positive numbers, got {low}, {high}")
        if self.near_lights > 0 and self.near_light_distance[0] <= largest:
            raise InputError(
                f"near_light_distance must be above the radius of the largest object ({largest:g} by scale and "
                f"upright_scale), got {self.near_light_distance[0]}"
            )
        if self.near_light_spread is not None and not 0 <= self.near_light_spread <= 1:
            raise InputError(f"near_light_spread must be in [0, 1], got {self.near_light_spread}")

    def stands(self, family: str) -> bool:
        """Return whether the shapes of a family have an up and stand."""
        return family in UPRIGHT or (family == OWN_MESHES and self.meshes is not None and self.meshes.upright)

    def tiles_of(self, family: str) -> int:
        """Return the tiles along each side of the image of a family."""
        return self.tiles if self.stands(family) else 1

    def is_framed(self, family: str) -> bool:
        """Return whether the views of a family depend on how the mesh fills them."""
        limits = (self.min_foreground.get(family, 0), self.min_normal_spread.get(family, 0))
        return self.tiles_of(family) > 1 or max(limits) > 0
