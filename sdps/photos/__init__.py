"""From a folder of photographs to what a photometric-stereo method sees: `load` reads it, `check` criticises it."""

from sdps.photos.checks import Finding, check
from sdps.photos.light_files import write_lights
from sdps.photos.reading import Photographs, load

__all__ = ["Finding", "Photographs", "check", "load", "write_lights"]
