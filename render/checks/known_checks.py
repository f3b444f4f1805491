"""The list of checks: what each is called, how bad a finding is, and what to do about it."""

from collections.abc import Callable
from dataclasses import dataclass

from render.checks import light_checks, shard_checks
from render.checks.shard_checks import Complaints, Limits
from render.records.shards import Shard

ERROR, WARNING, NOTE = "error", "warning", "note"
_AGAIN = "delete the shard and render it again with `sdps render-data`"


@dataclass(frozen=True)
class Check:
    """One thing that is looked at.

    Attributes:
        name: Name in the summary and in `validation.json`.
        level: `error` (the data are unusable as they are), `warning` (look at it) or `note` (no verdict).
        about: What holds of sound data, half a line.
        remedy: What to do about a finding.
        run: The check of one shard; None for checks of files and of the folder.
    """

    name: str
    level: str
    about: str
    remedy: str
    run: Callable[[Shard, Limits], Complaints] | None = None


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: which check, which scene or file, the measured value in words, and how bad it is."""

    check: str
    where: str
    message: str
    severity: float = 1.0


VALUES = Check("values", ERROR, "finite, not negative, below the half limit", _AGAIN, shard_checks.values)
CONTENT = (
    Check("normals", ERROR, "unit length in the mask, zero outside", _AGAIN, shard_checks.unit_normals),
    Check("facing", ERROR, "normals face the camera", "check the mesh's winding and the frame (z to the camera)",
          shard_checks.facing_normals),
    Check("mask", ERROR, "mask area within bounds, as the coverage says",
          "drop the scene, change its view, or move the bounds with --set min_area=... or max_area=...",
          shard_checks.mask_area),
    Check("depth", ERROR, "depth rises as the normals say", "check the frame and the unit of the depth",
          shard_checks.depth),
    Check("lights", ERROR, "unit directions above the horizon", "check where the directions come from",
          shard_checks.lights),
    Check("weights", ERROR, "material weights in [0, 1], sum 1", _AGAIN, shard_checks.material_weights),
    Check("objects", ERROR, "an object in every pixel of the mask", _AGAIN, shard_checks.objects),
    Check("black", ERROR, "no image black though its light faces the object", _AGAIN, light_checks.black_images),
    Check("shading", ERROR, "intensity rises with n.l as the frame says",
          "check the signs of normals and lights (x right, y up, z to the camera) and the order of the lights",
          light_checks.shading),
    Check("attached", ERROR, "dark where n.l is negative", "look for ambient light, or lights in another order",
          light_checks.check_attached_shadows),
    Check("exposure", WARNING, "bright enough for half precision", "check the irradiance (pi) and the material",
          light_checks.exposure),
    Check("unresolved", NOTE, "shading tells the handedness", "nothing to do unless most scenes are listed",
          light_checks.unresolved),
)  # fmt: skip
FILES = (
    Check("file", ERROR, "sealed digest, named parts, types and shapes", _AGAIN),
    Check("manifest", ERROR, "id, lights, size and digest of the manifest line", _AGAIN),
    Check("checksum", ERROR, "SHA-256 as in checksums.txt",
          "fetch the file again, or write the card again if the change was meant"),
)  # fmt: skip
FOLDER = (
    Check("ids", ERROR, "no id twice in the manifest", "plan the data again"),
    Check("twins", ERROR, "no two scenes of one view, lights and material", "plan the data again with another seed"),
    Check("duplicates", ERROR, "no two shards with the same pixels", "delete one and check how it came there"),
    Check("unplanned", WARNING, "every shard is in the manifest", "delete them, or use the manifest they belong to"),
    Check("temporary", WARNING, "no half-written file", "delete them when no render is running"),
)
CHECKS = {check.name: check for check in (*FILES, VALUES, *CONTENT, *FOLDER)}


def check_shard(shard: Shard, limits: Limits) -> list[Finding]:
    """Run every check of one shard; with non-finite values only that is reported, since nothing else can be measured.

    Args:
        shard: The scene.
        limits: Thresholds.
    """
    findings = _run(VALUES, shard, limits)
    if findings and any("infinite or NaN" in finding.message for finding in findings):
        return findings
    if not shard.mask.any():
        return [*findings, Finding("mask", shard.scene_id, "the mask is empty", 1.0)]
    for check in CONTENT:
        findings += _run(check, shard, limits)
    return findings


def _run(check: Check, shard: Shard, limits: Limits) -> list[Finding]:
    complaints = check.run(shard, limits) if check.run else ()
    return [Finding(check.name, shard.scene_id, message, severity) for message, severity in complaints]
