"""From a data configuration to the list of scenes, before the first pixel."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from render import lights as light_sets
from render.errors import InputError, unknown
from render.manifest import SceneSpec, View
from render.materials import library
from render.seeds import derived_seed, generator

UPRIGHT = ("sculpture", "bunny")  # families that stand; others have no up


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Which scenes to render.

    Attributes:
        seed: Root seed; 0 is a seed like any other.
        families: Seeded shape families and how many shapes of each.
        views: Random views per shape.
        materials_per_view: Different random materials per view (each is a sample of its own; they share rays).
        materials: Names, categories, or `all`; `lambertian:<albedo>` and YAML files are allowed.
        validation: Share of the shapes of each family kept for validation, in [0, 0.5]; rounded up when above 0.
        lights: Distribution of the light directions, drawn anew for each view.
        light_count: Lights per view.
        size: Image side in pixels, a multiple of 4.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces.
        scale: Range of the radius of the bounding sphere of blobs, in half image widths.
        upright_scale: The same for standing shapes, which fill less of their bounding sphere.
        offset: Largest image-plane offset of the object, in half image widths, per unit of scale above 0.5.
    """

    seed: int = 0
    families: dict[str, int] = field(default_factory=lambda: {"blobby": 8, "sculpture": 8})
    views: int = 2
    materials_per_view: int = 2
    materials: tuple[str, ...] = ("all",)
    validation: float = 0.05
    lights: str = "azimuth-elevation"
    light_count: int = 64
    size: int = 128
    spp: int = 16
    bounces: int = 2
    scale: tuple[float, float] = (0.75, 1.25)
    upright_scale: tuple[float, float] = (0.95, 2.0)
    offset: float = 0.25

    def __post_init__(self) -> None:
        for name in ("views", "materials_per_view", "light_count", "spp"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise InputError(f"seed must not be negative, got {self.seed}")
        if self.size < 16 or self.size % 4:
            raise InputError(f"size must be a multiple of 4 from 16 up, got {self.size}")
        if not 0 <= self.bounces <= 16:
            raise InputError(f"bounces must be in 0..16, got {self.bounces}")
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


def plan(config: DataConfig) -> list[SceneSpec]:
    """List every scene of `config`; the same configuration gives the same list.

    Scenes of one view differ only in material and stand together, so that the renderer can share their rays.

    Raises:
        InputError: an unknown family or material, or more materials per view than there are.
    """
    pool = material_pool(config.materials)
    if config.materials_per_view > len(pool):
        raise InputError(f"materials_per_view is {config.materials_per_view}, but there are {len(pool)} materials")
    scenes = []
    for family, count in config.families.items():
        held_out = int(np.ceil(config.validation * count))
        for number in range(count):
            split = "val" if number >= count - held_out else "train"
            for view in range(config.views):
                scenes += _plan_view(config, family, number, view, split, pool)
    if not scenes:
        raise InputError("families: no scene to render; raise a count above 0")
    return scenes


def material_pool(chosen: tuple[str, ...]) -> list[str]:
    """Expand `all` and category names into material names, keeping everything else that can be loaded.

    Raises:
        InputError: a name that is neither.
    """
    categories, pool = library.categories(), []
    for name in chosen:
        if name == "all":
            pool += library.names()
        elif name in categories:
            pool += categories[name]
        else:
            library.load(name)
            pool.append(name)
    return list(dict.fromkeys(pool))


def _plan_view(config: DataConfig, family: str, number: int, view: int, split: str, pool: list[str]) -> list[SceneSpec]:
    """Draw pose, lights and materials of one view; each from a stream of its own."""
    from render.shapes.registry import FAMILIES

    if family not in FAMILIES or not FAMILIES[family].seeded:
        raise unknown("shape family", family, [name for name, entry in FAMILIES.items() if entry.seeded])
    keys = (family, number, view)
    pose = random_view(config, family, generator(config.seed, *keys, "view"))
    directions = light_sets.draw(config.lights, config.light_count, generator(config.seed, *keys, "lights"))
    order = generator(config.seed, *keys, "materials").permutation(len(pool))[: config.materials_per_view]
    common = {
        "seed": derived_seed(config.seed, *keys, "sampler"),
        "split": split,
        "shape": f"{family}:{derived_seed(config.seed, family, number)}",
        "view": pose,
        "lights": tuple(tuple(round(float(c), 6) for c in row) for row in directions),
        "size": config.size,
        "spp": config.spp,
        "bounces": config.bounces,
    }
    name = f"{family}-{number:05d}-v{view}"
    return [SceneSpec(id=f"{name}-m{slot}", material=pool[index], **common) for slot, index in enumerate(order)]


def random_view(config: DataConfig, family: str, rng: np.random.Generator) -> View:
    """Draw a pose: any rotation for blobs; any yaw, but limited pitch and roll, for shapes that stand."""
    if family in UPRIGHT:
        # Turned about its own axis first, then tipped towards the camera (positive: seen from above), then rolled.
        yaw, pitch, roll = rng.uniform(-180, 180), rng.uniform(-30, 55), rng.uniform(-15, 15)
        rotation = Rotation.from_euler("yxz", [yaw, pitch, roll], degrees=True)
        scale = float(np.exp(rng.uniform(*np.log(config.upright_scale))))
    else:
        rotation = Rotation.random(rng=rng)
        scale = float(rng.uniform(*config.scale))
    reach = config.offset * max(scale - 0.5, 0.0)
    # Standing shapes are tall and thin: move along their height, or most of the frame is empty.
    spread = np.array([0.4, 1.6]) if family in UPRIGHT else np.ones(2)
    offset = rng.uniform(-reach, reach, 2) * spread
    return View(
        rotation=tuple(round(float(value), 9) for value in rotation.as_matrix().ravel()),
        scale=round(scale, 6),
        offset=(round(float(offset[0]), 6), round(float(offset[1]), 6)),
    )
