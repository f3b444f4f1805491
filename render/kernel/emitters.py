"""The lights of a view in the object frame: distant ones, or points near the object."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from render.backend.arrays import opaque, upload
from render.backend.jit import dr, mi
from render.kernel.camera import Camera


@dataclass(frozen=True)
class DistantLights:
    """Parallel light of irradiance pi from each of L directions."""

    directions: Any  # Vector3f (L), to the light

    def shadow_ray(self, start: Any, number: Any) -> tuple:
        """Return a direction to a light, of any length, and the ray that looks for it, from surface interactions."""
        direction = dr.gather(mi.Vector3f, self.directions, number)
        return direction, start.spawn_ray(direction)

    def towards(self, light: Any, _position: Any) -> tuple:
        """Return the unit directions from points to their lights, and the lights' irradiance / pi."""
        return dr.gather(mi.Vector3f, self.directions, light), mi.Float(1)

    def reach(self, light: Any, _position: Any) -> Callable[[Any], tuple]:
        """Return the function from vertex numbers to the unit directions to a lane's light and its irradiance / pi."""
        direction = dr.gather(mi.Vector3f, self.directions, light)
        return lambda _at: (direction, mi.Float(1))


@dataclass(frozen=True)
class NearLights:
    """Points that shine alike in all directions, with irradiance pi at the object's centre.

    So at distance d it is pi (d0 / d)^2, with d0 the light's distance from the centre.
    """

    positions: Any  # Point3f (L)
    distance2: Any  # Float (L), d0^2

    def shadow_ray(self, start: Any, number: Any) -> tuple:
        """Return a direction to a light, of any length, and the ray that looks for it, which ends there."""
        position = dr.gather(mi.Point3f, self.positions, number)
        return position - start.p, start.spawn_ray_to(position)

    def towards(self, light: Any, position: Any) -> tuple:
        """Return the unit directions from points to their lights, and the lights' irradiance / pi."""
        source, distance2 = dr.gather(mi.Point3f, self.positions, light), dr.gather(mi.Float, self.distance2, light)
        return _from(source, distance2, position)

    def reach(self, light: Any, position: Any) -> Callable[[Any], tuple]:
        """Return the function from vertex numbers to the unit directions to a lane's light and its irradiance / pi."""
        source, distance2 = dr.gather(mi.Point3f, self.positions, light), dr.gather(mi.Float, self.distance2, light)
        return lambda at: _from(source, distance2, dr.gather(mi.Point3f, position, at))


def _from(source: Any, distance2: Any, position: Any) -> tuple:
    """Return the unit directions from points to a source, and irradiance / pi there."""
    towards = source - position
    inverse = dr.rcp(dr.squared_norm(towards))
    return mi.Vector3f(towards * dr.sqrt(inverse)), distance2 * inverse


def place(camera: Camera, lights: np.ndarray, distances: np.ndarray | None) -> DistantLights | NearLights:
    """Turn lights into the object frame.

    Args:
        camera: Camera of the view.
        lights: (L, 3) unit vectors to the lights from the object's centre, camera frame.
        distances: (L,) from the centre, in half image widths; None for distant lights.
    """
    # Row by row, since a conversion of the whole would have the number of lights in its code.
    rows = np.asarray(lights, np.float32).T
    directions = opaque(camera.to_object(*(upload(mi.Float, row) for row in rows)))
    if distances is None:
        return DistantLights(directions)
    away = upload(mi.Float, np.asarray(distances, np.float32)) / camera.scale
    positions, distance2 = mi.Point3f(directions * away), dr.square(away)
    dr.eval(positions, distance2)
    return NearLights(positions, distance2)
