"""One view of an object under all its lights, from rays to what a shard holds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from render.backend import variant
from render.materials import surfaces as surface_names
from render.planning import provenance
from render.records import view_geometry
from render.records.manifest import SceneSpec
from render.records.shards import Shard, to_half
from render.shared.errors import InputError

if TYPE_CHECKING:
    from render.kernel.scene import Scene
    from render.materials.kernels.packed import PackedSurfaces


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Images and ground truth of one object in one material; camera frame: x right, y up, z to the camera.

    Attributes:
        scene: What was rendered: names, pose, lights, samples.
        images: (L, H, W, 3) float32, linear radiance; a white Lambertian surface that faces the light has 1.
        normals: (H, W, 3) float32, unit shading normals, with the relief of a texture, zero outside the mask.
        depth: (H, W) float32, z of the surface in half image widths, larger is nearer, zero outside the mask.
        mask: (H, W) bool, pixels of which at least half the samples hit the object.
        coverage: (H, W) float32 in [0, 1], share of samples that hit the object.
        weights: (M, H, W) float32, share of each of M materials in a pixel of the mask; None for a single material.
        objects: (H, W) uint32, which object of a composition each pixel shows, from 1, 0 outside the mask; None for a
            single object.
    """

    scene: SceneSpec
    images: np.ndarray
    normals: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    coverage: np.ndarray
    weights: np.ndarray | None = None
    objects: np.ndarray | None = None

    @property
    def light_directions(self) -> np.ndarray:
        """Unit vectors (L, 3) float32 from the surface to each light; to near lights, from the object's centre."""
        return self.scene.light_directions()

    @property
    def light_positions(self) -> np.ndarray | None:
        """Positions (L, 3) float32 of near lights, camera frame, half image widths; None for distant lights."""
        return self.scene.light_positions()

    @property
    def points(self) -> np.ndarray:
        """Points (H, W, 3) float64 of the surface, camera frame, half image widths; they hold inside the mask."""
        return view_geometry.points(self.depth, self.scene.view.camera_distance)

    @property
    def view_directions(self) -> np.ndarray:
        """Unit vectors (H, W, 3) float64 from the surface to the camera."""
        return view_geometry.view_directions(self.depth.shape, self.scene.view.camera_distance)

    def shard(self, name: str | None = None) -> Shard:
        """Return what `write_shard` writes: the same arrays, radiance rounded to half precision.

        Args:
            name: Id of the scene, if another than its own.
        """
        scene = self.scene if name is None else replace(self.scene, id=name)
        return Shard(
            scene_id=scene.id, images=to_half(self.images), normals=self.normals, depth=self.depth, mask=self.mask,
            coverage=self.coverage, light_directions=self.light_directions, weights=self.weights,
            materials=surface_names.split_name(scene.material)[1] if self.weights is not None else (),
            light_positions=self.light_positions, objects=self.objects,
            provenance=_describe(scene),
        )  # fmt: skip


def trace_views(
    built: "Scene", scenes: Sequence[SceneSpec], surfaces: "PackedSurfaces", only: Sequence[int]
) -> Iterator[RenderedView]:
    """Trace the rays of a view now; shade its scenes one by one as they are asked for.

    Args:
        built: The object.
        scenes: Scenes that differ in id and material only.
        surfaces: Their surfaces, in the same order.
        only: Numbers of the scenes to shade, rising; the bytes do not depend on it.

    Raises:
        InputError: images that are not square, or the object is outside the frame.
    """
    from render.kernel import many_lights

    first = scenes[0]
    height, width = first.resolution
    if height != width:
        raise InputError(f"scene {first.id}: size is {height}x{width}; only square images can be rendered")
    truth, images = many_lights.render(
        built, first.view, surfaces, first.light_directions(), size=height, spp=first.spp, bounces=first.bounces,
        seed=first.seed, distances=np.asarray(first.light_distances) if first.light_distances else None, only=only,
    )  # fmt: skip
    if not truth.mask.any():
        raise InputError(f"scene {first.id}: {first.shape} is outside the frame; check view.scale and view.offset")
    return (
        RenderedView(
            scenes[number],
            stack,
            truth.normals_of(number),
            truth.depth,
            truth.mask,
            truth.coverage,
            truth.weights[number],
            truth.objects,
        )
        for number, stack in images
    )


def _describe(scene: SceneSpec) -> dict[str, str | int | float]:
    """Describe how the scene was rendered, for the shard's header."""
    return {
        "spec": scene.digest(),
        "seed": scene.seed,
        "shape": scene.shape,
        "material": scene.material,
        "spp": scene.spp,
        "bounces": scene.bounces,
        "irradiance": "pi at the object's centre" if scene.light_distances else "pi",
        "frame": "x right, y up, z to the camera",
        "variant": variant.load().variant(),
        **_camera_and_lights(scene),
        **_software(_commit),
    }


def _camera_and_lights(scene: SceneSpec) -> dict[str, str | float]:
    """Describe a perspective camera, and where near lights have irradiance pi; nothing for plain scenes."""
    found: dict[str, str | float] = {}
    distance = scene.view.camera_distance
    if distance is not None:
        matrix = view_geometry.camera_matrix(scene.resolution[1], distance)
        found = {
            "camera": "perspective",
            "camera_distance": distance,
            "camera_matrix": " ".join(f"{value:.9g}" for value in matrix.ravel()),
            "field_of_view": view_geometry.field_of_view(distance),
        }
    if scene.light_distances:
        found["light_reference"] = "{:.9g} {:.9g} 0".format(*scene.view.offset)
    return found


_commit: str | None = None


def set_commit(commit: str | None) -> None:
    """Let the headers of this process's shards name a commit; None: that of this machine's copy."""
    global _commit
    _commit = commit


@cache
def _software(commit: str | None) -> dict[str, str]:
    """Return the versions of this package and of those a shard depends on, and the commit in a checkout."""
    versions = {name: version for name, version in provenance.versions().items() if name in provenance.PACKAGES}
    commit = provenance.commit() if commit is None else commit
    return versions | ({"commit": commit} if commit else {})
