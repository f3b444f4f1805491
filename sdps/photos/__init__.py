"""From a folder of photographs to what a photometric-stereo method sees: `load` reads it, `check` criticises it.

Of a folder, ZIP or film with several poses of an object, `find_poses` returns these, and `load` reads one.
"""

from typing import TYPE_CHECKING

from render.shared import lazy_names

if TYPE_CHECKING:
    from sdps.photos.checks import Finding, check
    from sdps.photos.light_files import write_lights
    from sdps.photos.pictures.sources.poses import Pose, find_poses
    from sdps.photos.reading import Photographs, load
else:  # so that the app's server, which asks for the kinds of pictures, loads none of the decoders
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "sdps.photos.checks": ("Finding", "check"),
            "sdps.photos.light_files": ("write_lights",),
            "sdps.photos.pictures.sources.poses": ("Pose", "find_poses"),
            "sdps.photos.reading": ("Photographs", "load"),
        },
    )

__all__ = ["Finding", "Photographs", "Pose", "check", "find_poses", "load", "write_lights"]
