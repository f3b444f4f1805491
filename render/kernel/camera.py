"""The cameras, in the object frame: the camera moves, so that the mesh's acceleration structure serves every view."""

from dataclasses import dataclass
from typing import Any, ClassVar

from render.backend.arrays import opaque
from render.backend.jit import dr, mi
from render.records.manifest import View

_START = 2.0  # radii of the object's unit sphere in front of its centre, where perspective rays start


@dataclass(frozen=True)
class Camera:
    """The orthographic camera."""

    rotation: Any  # Matrix3f, object to camera
    scale: Any  # Float
    offset: Any  # Point2f
    size: int
    parallel: ClassVar[bool] = True  # whether all rays have one direction

    @classmethod
    def of(cls, view: View, size: int) -> "Camera":
        """Return the camera of a view."""
        common = (
            opaque(mi.Matrix3f(view.matrix())), opaque(mi.Float(view.scale)), opaque(mi.Point2f(*view.offset)), size
        )  # fmt: skip
        if view.camera_distance is None:
            return Camera(*common)
        start = min(view.camera_distance, _START * view.scale)
        values = (view.camera_distance, start, 1 - start / view.camera_distance)
        return PerspectiveCamera(*common, *(opaque(mi.Float(value)) for value in values))

    def to_object(self, x: Any, y: Any, z: Any) -> "mi.Vector3f":
        """Turn a camera-frame direction into the object frame."""
        return mi.Vector3f(self.rotation.T @ mi.Vector3f(x, y, z))

    def towards(self, _position: Any) -> "mi.Vector3f":
        """Return the unit vectors from points to the camera; one for all."""
        return self.to_object(0, 0, 1)

    def image_area(self, area: Any, _position: Any) -> Any:
        """Return the image area of a small piece of surface at points, from its vector area (normal times area)."""
        return dr.abs(dr.dot(area, self.to_object(0, 0, 1))) * dr.square(self.scale)

    def ray(self, x: Any, y: Any) -> "mi.Ray3f":
        """Return the ray through image point (x, y) in [-1, 1]^2, x right, y up."""
        origin = self.to_object((x - self.offset.x) / self.scale, (y - self.offset.y) / self.scale, 4)
        return mi.Ray3f(mi.Point3f(origin), self.to_object(0, 0, -1))

    def project(self, position: Any) -> tuple:
        """Return the image coordinates (x, y) of points."""
        moved = self.rotation @ mi.Vector3f(position)
        return dr.fma(moved.x, self.scale, self.offset.x), dr.fma(moved.y, self.scale, self.offset.y)


@dataclass(frozen=True)
class PerspectiveCamera(Camera):
    """A pinhole at (0, 0, distance), looking along -z; the frame is [-1, 1]^2 of the plane z = 0."""

    distance: Any  # Float, in half image widths
    start: Any  # Float, z of the plane that rays start from: near the object, so that no digits are lost on the way
    narrowed: Any  # Float, width of the view in that plane over that in the plane z = 0
    parallel: ClassVar[bool] = False

    def towards(self, position: Any) -> "mi.Vector3f":
        """Return the unit vectors from points to the camera."""
        return mi.Vector3f(dr.normalize(self._eye() - mi.Vector3f(position)))

    def image_area(self, area: Any, position: Any) -> Any:
        """Return the image area of small pieces of surface at points, from their vector areas (normal times area).

        With r the way to the camera and z its part along the axis, one covers |area . r| / r^3 of solid angle, and a
        solid angle covers D^2 (r / z)^3 of the frame's plane, at the distance D.
        """
        sight = self._eye() - mi.Vector3f(position)
        along = dr.dot(sight, self.to_object(0, 0, 1))
        return dr.abs(dr.dot(area, sight)) / along * dr.square(self.distance / along)

    def _eye(self) -> "mi.Vector3f":
        """Return the position of the pinhole."""
        return self.to_object(*(value / self.scale for value in (-self.offset.x, -self.offset.y, self.distance)))

    def ray(self, x: Any, y: Any) -> "mi.Ray3f":
        """Return the ray through point (x, y) of the plane z = 0; on film, that image point."""
        across = (dr.fma(x, self.narrowed, -self.offset.x), dr.fma(y, self.narrowed, -self.offset.y), self.start)
        origin = self.to_object(*(value / self.scale for value in across))
        return mi.Ray3f(mi.Point3f(origin), dr.normalize(self.to_object(x, y, -self.distance)))

    def project(self, position: Any) -> tuple:
        """Return the image coordinates (x, y) of points in front of the camera."""
        x, y = super().project(position)
        z = (self.rotation @ mi.Vector3f(position)).z * self.scale
        shrunk = dr.rcp(1 - z / self.distance)
        return x * shrunk, y * shrunk
