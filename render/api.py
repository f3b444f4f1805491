"""Rendering from Python: images of your own mesh, material and lights, or a whole plan of scenes.

```python
import render

view = render.render_view("bunny", "gold-paint", "merltest", size=128)
view.images  # (L, 128, 128, 3) float32, linear radiance
view.normals, view.mask, view.depth  # x right, y up, z to the camera
render.write_shard("bunny.exr", view.shard())
```

Mitsuba is loaded by the first call that traces rays.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import trimesh

from render.materials import surfaces
from render.materials.library import AnyMaterial
from render.materials.model import Material
from render.materials.surfaces import Surface
from render.planning import light_sets
from render.records.manifest import SceneSpec, View, claim
from render.running.rendered_view import RenderedView, trace_views
from render.shapes import TriangleMesh, registry
from render.shapes.files.mesh_file import from_trimesh
from render.shared.errors import InputError

ShapeLike: TypeAlias = str | Path | trimesh.Trimesh | TriangleMesh
MaterialLike: TypeAlias = "str | Path | Surface | AnyMaterial"
LightsLike: TypeAlias = str | Path | np.ndarray

_UNIT = 1.001
"""Radius of the unit sphere, with some room for rounding."""
_OWN = "own"


def shape(source: ShapeLike) -> TriangleMesh:
    """Return an object to render: centred, its farthest vertex at radius 1, x right, y up, z to the camera.

    Args:
        source: A name (`sphere`, `bunny`, `blobby:17`, `sculpture:42`), the path of a mesh file that trimesh reads, a
            `trimesh.Trimesh`, or a `TriangleMesh` in the unit sphere, which is returned as it is.

    Raises:
        InputError: an unknown name (with the nearest), a file or mesh without usable triangles, or a `TriangleMesh`
            that reaches beyond the unit sphere.
    """
    if isinstance(source, TriangleMesh):
        reach = float(np.linalg.norm(source.vertices, axis=1).max())
        if reach > _UNIT:
            raise InputError(f"mesh: reaches to radius {reach:.3g}, beyond the unit sphere; use its normalise()")
        return source
    if isinstance(source, trimesh.Trimesh):
        return from_trimesh(source).normalise()
    return registry.load(str(source))


def material(source: MaterialLike) -> Surface:
    """Return what covers an object: one material, or several in a pattern.

    Args:
        source: A built-in name (`chrome`, `blue-fabric`, ...), `lambertian:0.5` or `lambertian:0.8/0.3/0.1` (linear RGB
            albedo), a file (`.yaml` of `fit_material`, `.binary` of MERL, `.bsdf` of RGL), a spatially varying surface
            (`stripes:7:chrome+blue-fabric`: pattern, seed, materials, which may be files), a textured one
            (`procedural:wood:7`, a folder of maps; `render.materials.textures.textured`), or a loaded material.

    Raises:
        InputError: an unknown name (with the nearest), a malformed pattern, or a file that is not a material.
    """
    if isinstance(source, Surface):
        return source
    if isinstance(source, str | Path):
        return surfaces.load(str(source))
    if not hasattr(source, "category"):
        raise InputError(f"material {source!r}: give a name, a file, or what fit_material returned")
    return Surface(source.name, (source,))


def lights(source: LightsLike) -> np.ndarray:  # (L, 3)
    """Return light directions, (L, 3) float64: unit vectors from the surface to the light, camera frame, z > 0.

    Args:
        source: A fixed set (`merltest`, `diligent`), a seeded draw (`near-uniform:32`, `hemisphere:64`,
            `azimuth-elevation:64`, `biased:64`), a file of directions, or an array (L, 3) or (3,) of any lengths.

    Raises:
        InputError: an unknown name, a malformed file or array, or a light below the horizon (named by its number).
    """
    if isinstance(source, str | Path):
        return light_sets.load(str(source))
    return light_sets.check(np.atleast_2d(np.asarray(source)).tolist(), "lights")


_shape, _material, _lights = shape, material, lights  # for functions whose parameters have these names


def render_view(shape: ShapeLike, material: MaterialLike, lights: LightsLike, **options: Any) -> RenderedView:
    """Render one object in one material under every light.

    Args:
        shape: See `shape`.
        material: See `material`.
        lights: See `lights`; L directions.
        options: Those of `render_views`: `size`, `spp`, `bounces`, `scale`, `rotation`, `offset`, `camera_distance`,
            `light_distance`, `seed`.

    Returns:
        The view; its `images` are (L, size, size, 3) float32, linear radiance in which a white Lambertian surface that
        faces a light has 1; its `normals`, `depth` and `mask` are those of `RenderedView`.

    Raises:
        InputError: as `render_views`.
    """
    (view,) = render_views(shape, [material], lights, **options)
    return view


def render_views(
    shape: ShapeLike,
    materials: Sequence[MaterialLike],
    lights: LightsLike,
    *,
    size: int = 128,
    spp: int = 64,
    bounces: int = 2,
    scale: float = 0.9,
    rotation: np.ndarray | None = None,
    offset: tuple[float, float] = (0.0, 0.0),
    camera_distance: float | None = None,
    light_distance: float | Sequence[float] | None = None,
    seed: int = 0,
) -> Iterator[RenderedView]:
    """Render one object in several materials, which share all rays; the camera looks along -z.

    Args:
        shape: See `shape`.
        materials: At least one, each as in `material`.
        lights: See `lights`; L lights of irradiance pi; directions from the object's centre where they are near.
        size: Image side in pixels.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces after the first hit, 0 to 16; 0 is direct light with cast shadows.
        scale: Radius of the object's unit sphere in half image widths, in (0, 10]; 1 touches the frame.
        rotation: (3, 3) rotation of column vectors, object to camera frame; None for as it is.
        offset: Translation in half image widths, (right, up).
        camera_distance: Distance of a perspective camera, a pinhole, from the plane of the object's centre, in half
            image widths, above `scale`: the field of view is 2 atan(1 / distance). None: orthographic.
        light_distance: Distance of near lights from the object's centre, in half image widths, above `scale`; one for
            all or L. Each has irradiance pi there, falling with the inverse square of the distance. None: distant.
        seed: Of the sampler; the same call gives the same bytes on one machine.

    Returns:
        A view per material, in order; each is computed when it is asked for.

    Raises:
        InputError: an unusable shape, material or light, an option out of range, or an object outside the frame.
    """
    _check_options(size, spp, bounces, seed)
    covers = [_material(each) for each in materials]
    if not covers:
        raise InputError("materials: at least one is needed")
    first = SceneSpec(
        id="view-0", split="test", shape=str(shape) if isinstance(shape, str | Path) else "mesh",
        material=covers[0].name, view=_view(rotation, scale, offset, camera_distance), size=size, spp=spp,
        bounces=bounces, seed=seed, **_read_lights(_lights(lights), light_distance),
    )  # fmt: skip
    return _render(_shape(shape), covers, first)


def _check_options(size: int, spp: int, bounces: int, seed: int) -> None:
    """Refuse options out of range."""
    if size < 1 or spp < 1 or seed < 0 or not 0 <= bounces <= 16:
        raise InputError(
            f"size and spp must be at least 1, seed 0 and bounces in 0..16, got {size}, {spp}, {seed} and {bounces}"
        )


def _render(mesh: TriangleMesh, covers: Sequence[Surface], first: SceneSpec) -> Iterator[RenderedView]:
    """Render scenes that differ from the first in their material only."""
    from render.kernel.scene import build
    from render.materials.kernels.packed import PackedSurfaces

    scenes = [replace(first, id=f"view-{number}", material=cover.name) for number, cover in enumerate(covers)]
    return trace_views(build(mesh), scenes, PackedSurfaces(covers, mesh), range(len(covers)))


def _read_lights(directions: np.ndarray, distance: float | Sequence[float] | None) -> dict[str, Any]:
    """Return the lights of a scene and, of near ones, their distances, or say what is wrong with these."""
    found: dict[str, Any] = {"lights": tuple(map(tuple, directions.tolist()))}
    if distance is None:
        return found
    values, count = np.asarray(distance, np.float64), len(directions)
    if values.shape not in ((), (count,)):
        raise InputError(f"light_distance: expected one number or {count}, got {values.size}")
    return found | {"light_distances": tuple(np.broadcast_to(values, count).tolist())}


def _view(
    rotation: np.ndarray | None, scale: float, offset: tuple[float, float], camera_distance: float | None
) -> View:
    """Return the pose, or say what is wrong with it."""
    matrix = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    if matrix.shape != (3, 3) or not np.linalg.det(matrix) > 0:
        raise InputError(f"rotation: expected a (3, 3) rotation matrix that does not mirror, got {matrix.tolist()}")
    return View(
        rotation=tuple(matrix.ravel().tolist()),
        scale=scale,
        offset=(float(offset[0]), float(offset[1])),
        camera_distance=None if camera_distance is None else float(camera_distance),
    )


def render_plan(scenes: Sequence[SceneSpec], folder: str | Path, *, workers: int = 1) -> list[Path]:
    """Write the manifest of a data folder and render every scene that has no whole shard there yet.

    Stopped and called again with the same plan, it goes on. The bytes of a shard depend on the plan alone.

    Args:
        scenes: Of `plan`; of a shape or material that is a file, the name is its path.
        folder: Data folder: gets `manifest.jsonl` and a shard `shards/<id>.exr` per scene.
        workers: 1 renders in this process. More render in as many processes, which start this program's main module
            again: call it below `if __name__ == "__main__":`. 0 takes what cores and memory allow.

    Returns:
        The shards' paths, in the order of the plan.

    Raises:
        InputError: another plan in the folder, an unusable shape or material, or a full disk. Finished shards stay.
    """
    folder = Path(folder)
    if not scenes:
        raise InputError("the plan is empty; there is nothing to render")
    claim(folder, scenes)
    if workers == 1:
        from render.running.scene_rendering import render_scenes

        render_scenes(scenes, folder)
    else:
        from render.running.supervisor import RunOptions, render_supervised

        failed = render_supervised(scenes, folder, RunOptions(workers=workers, retry_failed=True)).failed
        if failed:
            raise InputError(
                f"{folder}: {len(failed)} of {len(scenes)} scenes failed, the first was {failed[0]['id']}: "
                f"{failed[0]['reason']}"
            )
    return [folder / scene.file for scene in scenes]


def fit_material(
    file: str | Path, brdf: Callable[[np.ndarray, np.ndarray], np.ndarray], *, source: str = "", terms: str = ""
) -> Material:
    """Fit the built-in reflectance model to your own BRDF, and write it as a material file.

    The model is isotropic and reciprocal, tabulated over half and difference angle; `fit_error` of the result is the
    relative RMS error of a sphere under 20 lights. Where the BRDF reflects more light than it receives, it is lowered.

    Args:
        file: Where the material goes, `<name>.yaml`; to be used wherever a material is named.
        brdf: Function of unit vectors `wi` (to the light) and `wo` (to the camera), each (N, 3) float64 in the frame
            of the surface (z is its normal), that gives the BRDF (N, 3) in 1/sr, linear RGB. NaN where it is unknown.
        source: Where it comes from, for the file.
        terms: Terms of use, for the file.

    Raises:
        InputError: another suffix, values that are not a BRDF, or a file that cannot be written.
    """
    from render.materials.fit.fitting import Fitter, to_yaml
    from render.shared.files import write_text

    file = Path(file)
    if file.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{file}: a fitted material must end in .yaml")

    def checked(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        values = np.asarray(brdf(wi, wo), np.float64)
        if values.shape != wi.shape or (values < 0).any():
            raise InputError(f"brdf: must give {wi.shape} values >= 0 for directions of that shape, got {values.shape}")
        return values

    about = {"source": source or "fit to a BRDF given in Python", "terms": terms or "not stated"}
    fitted = Fitter().fit(file.stem, checked, family=_OWN, **about)
    write_text(file, to_yaml(fitted))
    return fitted
