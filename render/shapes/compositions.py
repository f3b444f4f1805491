"""Compositions: several objects in one scene that touch without passing through each other, one scene per seed.

Each object falls along a straight line until it touches what lies there (`render.shapes.geometry.contact`), is lifted a
little, pushed towards the others until it touches them, and falls again. Nothing is simulated: an object falls where
it would roll to without turning, rests where it touches first, and lies in the lowest of several poses.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from render.shapes import grounds
from render.shapes.blobby import blobby
from render.shapes.geometry import sdf
from render.shapes.geometry.contact import free_path
from render.shapes.geometry.mesh import TriangleMesh, join
from render.shapes.geometry.noise import scalar_waves
from render.shapes.geometry.polygonise import polygonise
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture.family import RECIPES, weather
from render.shared import seeds

TRIANGLES = 30_000  # of an object
DOWN, UP, BACK = np.array([0.0, -1, 0]), np.array([0.0, 1, 0]), np.array([0.0, 0, -1])
_LIFT = 0.04  # before an object is pushed over the ground
_CELL = 0.03  # of the grid in which objects roll
_HALF_GRID = 50
_POSES = 16
_STANDING = ("statue", "group", "bust", "animal", "vessel")


def composition(seed: int) -> TriangleMesh:
    """Build the composition of `seed` within the unit sphere, y up; its faces carry the numbers of their objects.

    Object 0 is the ground, bowl or niche where there is one.
    """
    rng = seeds.generator(seed, "composition")
    return join(KINDS[kind(seed)][0](rng)).normalise()


def kind(seed: int) -> str:
    """Return the name of the kind of composition that `seed` draws."""
    shares = np.array([share for _, share in KINDS.values()])
    rng = seeds.generator(seed, "composition", "kind")
    return list(KINDS)[rng.choice(len(shares), p=shares / shares.sum())]


def heap(rng: np.random.Generator) -> list[TriangleMesh]:
    """Heap objects on a ground."""
    pile = [_mesh(grounds.ground(rng), 1.4)]
    return _heap(rng, pile, [_scale(rng, part(rng), 0.25, 0.47) for _ in range(int(rng.integers(3, 7)))], 0.66)


def in_bowl(rng: np.random.Generator) -> list[TriangleMesh]:
    """Fill a bowl, which stands on a ground in half of the cases."""
    pile = [_mesh(grounds.bowl(rng), 1.2)]
    if rng.random() < 0.5:
        slab = _mesh(grounds.ground(rng), 1.4)
        pile = [slab, _drop_onto(pile[0], [slab])]
    return _heap(rng, pile, [_scale(rng, part(rng), 0.28, 0.5) for _ in range(int(rng.integers(2, 6)))], 0.5)


def before_wall(rng: np.random.Generator) -> list[TriangleMesh]:
    """Put objects on a ground and push them against the wall behind, or against those before it."""
    pile = [_mesh(grounds.corner(rng), 2.2)]
    for number in range(int(rng.integers(2, 6))):
        body = _scale(rng, part(rng), 0.3, 0.6)
        start = np.array([(-0.35, 0.35, 0.0, -0.2, 0.2)[number] + rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.35)])
        _settle(pile, _at(body, *_roll_down(_at(body, 0, 0), pile, start, 0.6)), BACK, 0.9)
    return pile


def in_niche(rng: np.random.Generator) -> list[TriangleMesh]:
    """Put an object before a niche and push it in, and at times others after it."""
    pile = [_mesh(grounds.niche(rng), 2.2)]
    for number in range(int(rng.integers(1, 4))):
        body = _scale(rng, part(rng), *((0.4, 0.55) if number == 0 else (0.2, 0.33)))
        reach = float(body.vertices[:, 2].min() - body.vertices[:, 2].mean())
        _settle(pile, _at(body, rng.uniform(-0.1, 0.1) * (1 + 2 * number), 0.2 - reach), BACK, 1.2)
    return pile


def links(rng: np.random.Generator) -> list[TriangleMesh]:
    """Build a chain: each ring goes through the one before it and is pulled along x until it hangs in it."""
    chain: list[TriangleMesh] = []
    ring, position, roll = rng.uniform(0.45, 0.6), 0.0, 0.0
    for number in range(int(rng.integers(2, 5))):
        tube = ring * rng.uniform(0.2, 0.33)
        form = sdf.torus([0, 0, 0], ring, tube, sdf.rotation("x", roll))
        if rng.random() < 0.6:
            form = sdf.displace(form, scalar_waves(rng, 4, 30, slope=1.2), tube * rng.uniform(0.02, 0.08))
        link = _move(_mesh(form, 1.2), np.array([position, 0, 0]))
        if number:
            link = _move(link, np.array([1.0, 0, 0]) * free_path(link, chain[-1], np.array([1.0, 0, 0])))
        chain.append(link)
        position = float(link.vertices[:, 0].min() + link.vertices[:, 0].max()) / 2 + ring
        roll += 90 + rng.uniform(-25, 25)
    turn = Rotation.random(rng=rng).as_matrix()
    return [link.rotate(turn) for link in chain]


def concave(rng: np.random.Generator) -> list[TriangleMesh]:
    """Build a single deeply concave object, in half of the cases on a ground."""
    body = polygonise(weather(rng, grounds.hollow(rng)), half_size=1.7, triangles=2 * TRIANGLES).normalise()
    if rng.random() < 0.5:
        return [body]
    pile = [_mesh(grounds.ground(rng), 1.4)]
    _settle(pile, replace(body, vertices=body.vertices * 0.85))
    return pile


KINDS: dict[str, tuple[Callable[[np.random.Generator], list[TriangleMesh]], float]] = {
    "heap": (heap, 0.3),
    "bowl": (in_bowl, 0.18),
    "wall": (before_wall, 0.16),
    "niche": (in_niche, 0.12),
    "links": (links, 0.08),
    "concave": (concave, 0.16),
}


def part(rng: np.random.Generator) -> TriangleMesh:
    """Build one object in the unit sphere, turned as it stands or lies: a blob, a sculpture, or a simple solid."""
    choice = rng.random()
    if choice < 0.3:
        return _lay_down(rng, blobby(int(rng.integers(2**31))))
    if choice < 0.65:
        name = str(rng.choice(list(RECIPES)))
        form, stands = weather(rng, RECIPES[name][0](rng)), name in _STANDING and rng.random() < 0.8
    else:
        form, stands = _solid(rng), False
    mesh = polygonise(form, half_size=1.7, triangles=TRIANGLES).normalise()
    return mesh.rotate(sdf.rotation("y", rng.uniform(-180, 180))) if stands else _lay_down(rng, mesh)


def _solid(rng: np.random.Generator) -> Field:
    """Return a simple solid, worn at the edges: brick, can, ring, egg, club or cup."""
    size, wear = rng.uniform(0.35, 0.9, 3), rng.uniform(0.02, 0.1)
    height = rng.uniform(0.4, 0.9)
    cup = sdf.subtraction(
        sdf.cylinder([0, 0, 0], 0.7, height, 0.05), sdf.cylinder([0, 0.2, 0], 0.6, height + 0.05, 0.05), 0.03
    )
    forms: list[Field] = [
        sdf.box([0, 0, 0], size, wear),
        sdf.cylinder([0, 0, 0], size[0], size[1], wear),
        sdf.torus([0, 0, 0], 0.7, rng.uniform(0.15, 0.3)),
        sdf.ellipsoid([0, 0, 0], size),
        sdf.cone([0, -0.7, 0], [0, 0.7, 0], size[0] / 2, size[1] / 3),
        cup,
    ]
    return forms[int(rng.integers(len(forms)))]


def _mesh(form: Field, half_size: float) -> TriangleMesh:
    return polygonise(form, half_size=half_size, triangles=TRIANGLES)


def _lay_down(rng: np.random.Generator, mesh: TriangleMesh) -> TriangleMesh:
    """Turn an object so that its middle is low, as that of one at rest is: the lowest of `_POSES` random poses."""
    turns = Rotation.random(_POSES, rng=rng).as_matrix()  # (P, 3, 3)
    points = mesh.vertices - mesh.vertices.mean(0)
    heights = (-turns[:, 1] @ points.T).max(1)
    return mesh.rotate(turns[int(heights.argmin())])


def _scale(rng: np.random.Generator, mesh: TriangleMesh, low: float, high: float) -> TriangleMesh:
    """Scale an object of the unit sphere to a radius between two."""
    return replace(mesh, vertices=mesh.vertices * rng.uniform(low, high))


def _move(mesh: TriangleMesh, by: np.ndarray) -> TriangleMesh:
    return replace(mesh, vertices=(mesh.vertices + by).astype(np.float32))


def _at(mesh: TriangleMesh, x: float, z: float) -> TriangleMesh:
    """Move the middle of an object to a place over the ground."""
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return _move(mesh, np.array([x - middle[0], 0, z - middle[2]]))


def _free_distance(mesh: TriangleMesh, pile: list[TriangleMesh], direction: np.ndarray, most: float = np.inf) -> float:
    """Return how far an object can go before it touches one of a pile; the last ones are touched most often."""
    for other in reversed(pile):
        most = free_path(mesh, other, direction, most)
    return most


def _drop_onto(mesh: TriangleMesh, pile: list[TriangleMesh]) -> TriangleMesh:
    """Let an object fall from above a pile, some of which is below it."""
    top = max(float(other.vertices[:, 1].max()) for other in pile)
    raised = _move(mesh, UP * (top - float(mesh.vertices[:, 1].min()) + 0.1))
    return _move(raised, DOWN * _free_distance(raised, pile, DOWN))


def _settle(pile: list[TriangleMesh], mesh: TriangleMesh, push: np.ndarray = DOWN, most: float = 0.0) -> None:
    """Add an object to a pile: let it fall, push it at most so far along the ground, and let it fall again."""
    fallen = _drop_onto(mesh, pile)
    if most > 0:
        fallen = _move(fallen, UP * _free_distance(fallen, pile, UP, _LIFT))
        fallen = _move(fallen, push * _free_distance(fallen, pile, push, most))
        fallen = _move(fallen, DOWN * _free_distance(fallen, pile, DOWN))
    pile.append(fallen)


def _heap(
    rng: np.random.Generator, pile: list[TriangleMesh], bodies: list[TriangleMesh], spread: float
) -> list[TriangleMesh]:
    """Add objects, the largest first, each from where it rolls down the others, then pushed back to them."""
    for body in sorted(bodies, key=lambda mesh: -float(np.ptp(mesh.vertices, axis=0).prod())):
        start = rng.uniform(-0.25, 0.25, 2)
        place = _roll_down(_at(body, 0, 0), pile, start, spread)
        far = float(np.hypot(*place))
        towards = np.array([-place[0], 0, -place[1]]) / max(far, 1e-6)
        _settle(pile, _at(body, *place), towards, far)
    return pile


def _roll_down(mesh: TriangleMesh, pile: list[TriangleMesh], start: np.ndarray, spread: float) -> np.ndarray:  # (2,)
    """Return the place (x, z) within a radius `spread` where an object that starts above a pile rolls to.

    It moves to where, of the places around, it would lie lowest, until it lies lower than around. Heights are those of
    the vertices in a grid of cells, which is enough to choose a place; the fall itself is exact.
    """
    top = np.zeros((2 * _HALF_GRID,) * 2)
    for other in pile:
        x, z = (np.floor(other.vertices[:, (0, 2)] / _CELL).astype(np.int64) + _HALF_GRID).T
        inside = (np.minimum(x, z) >= 0) & (np.maximum(x, z) < 2 * _HALF_GRID)
        np.maximum.at(top, (x[inside], z[inside]), other.vertices[inside, 1])
    own = np.floor(mesh.vertices[:, (0, 2)] / _CELL).astype(np.int64)
    cells, number = np.unique(own, axis=0, return_inverse=True)
    bottom = np.full(len(cells), np.inf)
    np.minimum.at(bottom, number.ravel(), mesh.vertices[:, 1])

    def height(place: tuple[int, int]) -> float:
        if np.hypot(*place) * _CELL > spread:
            return np.inf
        x, z = np.clip(cells + place + np.int64(_HALF_GRID), 0, 2 * _HALF_GRID - 1).T
        return float((top[x, z] - bottom).max())

    around = [(step * dx, step * dz) for step in (1, 3) for dx in (-1, 0, 1) for dz in (-1, 0, 1) if dx or dz]
    place, lowest = (int(start[0] / _CELL), int(start[1] / _CELL)), np.inf
    while (here := height(place)) < lowest:
        lowest = here
        best = min(((place[0] + dx, place[1] + dz) for dx, dz in around), key=height)
        place = best if height(best) < here else place
    return np.array(place) * _CELL
