"""From a data configuration to the list of scenes, before the first pixel."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from render.backend.orphans import end_with_parent
from render.materials import library, surfaces
from render.materials.textures import textured
from render.planning import light_sets
from render.planning.data_config import MIXED, PERSPECTIVE, DataConfig
from render.planning.mesh_family import choose
from render.records.manifest import COMPOSITION, OWN_MESHES, SceneSpec, View
from render.shared.errors import InputError, unknown
from render.shared.progress import progress_bar
from render.shared.seeds import derive_seed, generator

__all__ = ["DataConfig", "is_validation", "material_pool", "plan", "random_view"]

POSES_TRIED = 24  # per view, before the shape is given up
SHAPES_TRIED = 8
HELD_OUT = "held-out"  # the materials that training never sees
_CLEAR = 1.5  # of the object's radius: no camera stands nearer
EMPTY = 0.02  # share of the frame below which a tile shows nothing worth rendering


def plan(config: DataConfig, processes: int = 1) -> list[SceneSpec]:
    """List every scene of `config`; the same configuration gives the same list.

    Scenes of one view differ only in material and stand together, so that the renderer can share their rays.

    Args:
        config: What to render.
        processes: Processes that share the work where views depend on the mesh; they change nothing in the list.

    Raises:
        InputError: an unknown family or material, more materials per view than there are, or a shape that cannot be
            framed as the configuration asks.
    """
    from render.shapes.registry import FAMILIES

    pool = material_pool(config.materials)
    wanted = {"materials_per_view": config.materials_per_view}
    if config.spatially_varying:
        wanted["mixture"] = config.mixture[1]
    if config.families.get(COMPOSITION):
        wanted["composition_materials"] = config.composition_materials[1]
    most = max(wanted.values())
    if most > len(pool):
        name = next(key for key, value in wanted.items() if value == most)
        raise InputError(f"{name} is {most}, but there are {len(pool)} materials")
    weights = material_weights(config, pool)
    if weights is not None and np.count_nonzero(weights) < most:
        raise InputError(f"material_weights leave {np.count_nonzero(weights)} materials, {most} are drawn at once")
    unseen = material_pool(config.validation_materials)
    joined = next((name for name in pool if "+" in name and not textured.is_textured(name)), None)
    if config.spatially_varying and joined:
        raise InputError(f"materials: {joined!r} has a '+' and cannot be mixed with others; leave it out or rename it")
    known = [*(name for name, entry in FAMILIES.items() if entry.seeded), OWN_MESHES]
    for family in config.families:
        if family not in known:
            raise unknown("shape family", family, known)
    shapes = [(family, number) for family, count in config.families.items() for number in range(count)]
    if not shapes:
        raise InputError("families: no scene to render; raise a count above 0")
    count = config.families.get(OWN_MESHES, 0)
    meshes = choose(config.meshes, config.seed, count) if config.meshes and count else []
    framed = any(config.is_framed(family) for family, _ in shapes)
    with _mapping(processes if framed else 1) as mapping:
        planned = mapping(partial(_plan_shape, config, _Materials(pool, weights, unseen), meshes), shapes)
        bar = progress_bar(planned, total=len(shapes), desc="plan", unit="shape", disable=not framed)
        return [scene for scenes in bar for scene in scenes]


class _Materials(NamedTuple):
    """What scenes are made of.

    Attributes:
        pool: Names.
        weights: (M,) probability of each, or None for equal ones.
        unseen: Names for validation scenes alone.
    """

    pool: list[str]
    weights: np.ndarray | None
    unseen: list[str]

    def order(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw the numbers of `count` different materials of the pool."""
        if self.weights is None:
            return rng.permutation(len(self.pool))[:count]
        return rng.choice(len(self.pool), size=count, replace=False, p=self.weights)


def material_weights(config: DataConfig, pool: list[str]) -> np.ndarray | None:  # (M,)
    """Return the probability of each material of a pool, or None where all are equal.

    Raises:
        InputError: a weight for what is neither a material of the pool nor a category of one.
    """
    if not config.material_weights:
        return None
    kinds = [_category(name) for name in pool]
    for name in config.material_weights:
        if name not in pool and name not in kinds:
            raise unknown("material or category in material_weights:", name, {*pool, *kinds})
    given = config.material_weights
    weights = np.array([given.get(name, given.get(kind, 1.0)) for name, kind in zip(pool, kinds, strict=True)])
    return weights / max(weights.sum(), 1e-12)


def _category(name: str) -> str:
    """Return the category of a material of a pool; all kinds of procedural ones whose seed is to be drawn are one."""
    return textured.PROCEDURAL if textured.is_open(name) else surfaces.load(name).components[0].category


@contextmanager
def _mapping(processes: int) -> Iterator[Any]:
    """Yield `map`, or one that spreads the work over processes and keeps its order."""
    if processes <= 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=end_with_parent) as executor:
        try:
            yield partial(executor.map, chunksize=4)
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


def is_validation(number: int, share: float) -> bool:
    """Return whether shape `number` of a family is held out for validation.

    Every 1/share-th shape is, the first one included, so of the first N shapes exactly ceil(share N), and whether a
    shape is does not depend on how many there are.
    """
    return share > 0 and (number == 0 or int(round(number * share, 9)) > int(round((number - 1) * share, 9)))


def material_pool(chosen: tuple[str, ...]) -> list[str]:
    """Expand `all`, `held-out` and category names into material names, keeping everything else that can be loaded.

    `procedural` becomes `procedural:<kind>` of each kind, of which every scene draws its own (`textured.drawn`).

    Raises:
        InputError: a name that is neither.
    """
    categories, pool = library.categories(), []
    for name in chosen:
        if name == "all":
            pool += library.names()
        elif name == HELD_OUT:
            pool += library.held_out()
        elif name == textured.PROCEDURAL:
            pool += [f"{name}:{kind}" for kind in textured.KINDS]
        elif name in categories:
            pool += categories[name]
        else:
            if not textured.is_open(name):
                surfaces.load(name)
            pool.append(name)
    return list(dict.fromkeys(pool))


def _plan_shape(config: DataConfig, materials: _Materials, meshes: list[str], key: tuple[str, int]) -> list[SceneSpec]:
    """Plan all views of one shape; a seeded shape that cannot be framed as asked is replaced by another one."""
    family, number = key
    own = [meshes[number % len(meshes)]] if family == OWN_MESHES else []
    # The split of a file is that of its place, however often it comes.
    held_out = is_validation(number % len(meshes) if own else number, config.validation)
    for attempt in range(1 if own else SHAPES_TRIED):
        replaced = ("instead", attempt) if attempt else ()
        shape = own[0] if own else f"{family}:{derive_seed(config.seed, family, number, *replaced)}"
        views = _views(config, family, number, shape)
        if views is not None:
            return [
                scene
                for view, pose in enumerate(views)
                for scene in _plan_view(config, (family, number, view), shape, pose, materials, held_out)
            ]
    tried = f"{own[0].split(':', 3)[3]} has" if own else f"{SHAPES_TRIED} shapes in turn have"
    raise InputError(
        f"{family} {number}: {tried} a view without a fitting pose in {POSES_TRIED}; lower "
        f"min_foreground.{family} or min_normal_spread.{family}, or raise the scale"
    )


def _views(config: DataConfig, family: str, number: int, shape: str) -> list[View] | None:
    """Draw the poses of a shape, or None when one of them cannot be framed as asked."""
    if not config.is_framed(family):
        return [
            _draw_pose(config, (family, number, view), generator(config.seed, family, number, view, "view"))
            for view in range(config.views)
        ]
    from render.shapes import load

    mesh, views = load(shape), []
    for view in range(config.views):
        pose = _draw_view(config, family, (family, number, view), mesh)
        if pose is None:
            return None
        views.append(pose)
    return views


def _draw_pose(config: DataConfig, keys: tuple[Any, ...], rng: np.random.Generator) -> View:
    """Draw a pose, and the camera's distance where it is perspective."""
    pose = random_view(config, keys[0], rng)
    halves = generator(config.seed, *keys, "cameras")
    if config.camera != PERSPECTIVE and not (config.camera == MIXED and halves.random() < 0.5):
        return pose
    low, high = (max(limit, _CLEAR * pose.scale) for limit in config.camera_distance)
    (distance,) = _distances((low, high), 1, generator(config.seed, *keys, "camera"))
    return replace(pose, camera_distance=distance)


def _distances(limits: tuple[float, float], count: int, rng: np.random.Generator) -> tuple[float, ...]:
    """Draw distances uniformly in 1 / distance, which what they change in an image follows."""
    low, high = limits
    return tuple(round(1 / max(float(value), 1e-6), 6) for value in rng.uniform(1 / high, 1 / low, count))


def _near(config: DataConfig, keys: tuple[Any, ...]) -> tuple[float, ...]:
    """Draw the distances of a view's lights; none where they are distant."""
    rng = generator(config.seed, *keys, "near")
    if rng.random() >= config.near_lights:
        return ()
    if config.near_light_spread is None:
        return _distances(config.near_light_distance, config.light_count, rng)
    (common,) = _distances(config.near_light_distance, 1, rng)
    factors = np.exp(rng.uniform(0, config.near_light_spread) * rng.standard_normal(config.light_count))
    least = config.near_light_distance[0]  # beyond the object
    return tuple(round(max(common * float(factor), least), 6) for factor in factors)


def _draw_view(config: DataConfig, family: str, keys: tuple[Any, ...], mesh: Any) -> View | None:
    """Draw poses until one, or one of its tiles, shows enough of the shape."""
    from render.planning.framing import measure, tile_view

    tiles = config.tiles_of(family)
    least = max(config.min_foreground.get(family, 0.0), EMPTY)
    for attempt in range(POSES_TRIED):
        again = (attempt,) if attempt else ()
        pose = _draw_pose(config, keys, generator(config.seed, *keys, "view", *again))
        framing = measure(mesh, pose, tiles)
        fits = (framing.foreground >= least) & (framing.spread >= config.min_normal_spread.get(family, 0.0))
        if fits.any():
            choice = generator(config.seed, *keys, "tile", *again).choice(np.flatnonzero(fits))
            return tile_view(pose, *divmod(int(choice), tiles), tiles)
    return None


def _plan_view(
    config: DataConfig, keys: tuple[Any, ...], shape: str, pose: View, materials: _Materials, held_out: bool
) -> list[SceneSpec]:
    """Draw lights and materials of one view; each from a stream of its own."""
    family, number, view = keys
    directions = light_sets.draw(config.lights, config.light_count, generator(config.seed, *keys, "lights"))
    order = materials.order(generator(config.seed, *keys, "materials"), config.materials_per_view)
    surface = [_surface(config, (*keys, "surface", slot), materials, index) for slot, index in enumerate(order)]
    if held_out and materials.unseen:
        drawn = generator(config.seed, *keys, "unseen").permutation(len(materials.unseen))
        surface[1::2] = [materials.unseen[index] for index in np.resize(drawn, len(surface[1::2]))]
    streams = (generator(config.seed, *keys, "texture", slot) for slot in range(len(surface)))
    surface = [textured.complete(name, rng) for name, rng in zip(surface, streams, strict=True)]
    common: dict[str, Any] = {
        "seed": derive_seed(config.seed, *keys, "sampler"),
        "split": "val" if held_out else "train",
        "shape": shape,
        "view": pose,
        "lights": tuple(tuple(round(float(c), 6) for c in row) for row in directions),
        "size": config.size,
        "spp": config.spp,
        "bounces": config.composition_bounces if family == COMPOSITION else config.bounces,
        "light_distances": _near(config, keys),
    }
    name = f"{config.prefix}{family}-{number:05d}-v{view}"
    return [SceneSpec(id=f"{name}-m{slot}", material=material, **common) for slot, material in enumerate(surface)]


def _surface(config: DataConfig, keys: tuple[Any, ...], materials: _Materials, first: int) -> str:
    """Name the surface of a scene: material `first` alone, or mixed with others by a seeded pattern.

    The objects of a composition have materials of their own, unless the first one is textured and covers them all.
    """
    rng, pool = generator(config.seed, *keys), materials.pool
    composed = keys[0] == COMPOSITION
    if (not composed and rng.random() >= config.spatially_varying) or textured.is_textured(pool[first]):
        return pool[first]
    fewest, most = config.composition_materials if composed else config.mixture
    count = int(rng.integers(fewest, most + 1))
    drawn = rng.permutation(len(pool)) if materials.weights is None else materials.order(rng, count)
    others = [k for k in drawn if k != first and not textured.is_textured(pool[k])][: count - 1]
    if not others:
        return pool[first]
    names = "+".join(pool[index] for index in (first, *others))
    pattern = "parts" if composed else config.patterns[int(rng.integers(len(config.patterns)))]
    return f"{pattern}:{int(rng.integers(2**31))}:{names}"


def random_view(config: DataConfig, family: str, rng: np.random.Generator) -> View:
    """Draw a pose: any rotation for blobs; any yaw, but limited pitch and roll, for shapes that stand.

    Compositions are seen from their open side, and from above.
    """
    if family == COMPOSITION:
        angles = [rng.uniform(-50, 50), rng.uniform(12, 75), rng.uniform(-15, 15)]
        rotation = Rotation.from_euler("yxz", angles, degrees=True)
        scale = float(np.exp(rng.uniform(*np.log(config.upright_scale))))
    elif config.stands(family):
        # Turned about its own axis first, then tipped towards the camera (positive: seen from above), then rolled.
        yaw, pitch, roll = rng.uniform(-180, 180), rng.uniform(-30, 55), rng.uniform(-15, 15)
        rotation = Rotation.from_euler("yxz", [yaw, pitch, roll], degrees=True)
        scale = float(np.exp(rng.uniform(*np.log(config.upright_scale))))
    else:
        rotation = Rotation.random(rng=rng)
        scale = float(rng.uniform(*config.scale))
    reach = config.offset * max(scale - 0.5, 0.0)
    # Standing shapes are tall and thin: move along their height, or most of the frame is empty.
    spread = np.array([0.4, 1.6]) if config.stands(family) and family != COMPOSITION else np.ones(2)
    offset = rng.uniform(-reach, reach, 2) * spread
    return View(
        rotation=tuple(round(float(value), 9) for value in rotation.as_matrix().ravel()),
        scale=round(scale, 6),
        offset=(round(float(offset[0]), 6), round(float(offset[1]), 6)),
    )
