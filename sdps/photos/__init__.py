"""From a folder of photographs to what a photometric-stereo method sees: `load` reads it, `check` criticises it."""

from typing import TYPE_CHECKING

from render.shared import lazy_names

if TYPE_CHECKING:
    from sdps.photos.checks import Finding, check
    from sdps.photos.light_files import write_lights
    from sdps.photos.reading import Photographs, load
else:  # so that the app's server, which asks for the kinds of pictures, loads none of the decoders
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "sdps.photos.checks": ("Finding", "check"),
            "sdps.photos.light_files": ("write_lights",),
            "sdps.photos.reading": ("Photographs", "load"),
        },
    )

__all__ = ["Finding", "Photographs", "check", "load", "write_lights"]
