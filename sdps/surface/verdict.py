"""One sentence that says when a result is not to be used, and the likeliest reason."""

from collections.abc import Iterator, Sequence

import numpy as np

from sdps.photos import Finding, Photographs
from sdps.refinement.trust import FEWEST_IMAGES, Trust

UNUSABLE = 15.0
"""Mean angle to the true normals to expect, in degrees, from which on a result is not to be used."""
_MISFIT = 0.05
"""Mean residual of refinement above which its model does not describe the object's reflectance."""


def give_verdict(
    photos: Photographs,
    expected: np.ndarray | None,
    findings: Sequence[Finding],
    trust: Trust | None = None,
    residual: float = 0.0,
) -> str:
    """Return why the normals found are not to be used; empty where nothing speaks against them.

    Args:
        photos: What was photographed.
        expected: (H, W) degrees, angle to the true normals to expect; None where nothing predicts it.
        findings: What the checks said.
        trust: What refinement says of itself, where it ran.
        residual: Mean residual of refinement.
    """
    mean = 0.0 if expected is None else float(expected[photos.mask].mean())
    grave = [finding.text for finding in findings if finding.level == "error"]
    if mean < UNUSABLE and not grave:
        return ""
    reasons = (*grave, *_reasons(photos, findings, trust, residual), "no network has learned objects like this one")
    how = f"the normals are off by an estimated {mean:.0f} degrees" if mean >= UNUSABLE else "a check failed"
    return f"NOT TO BE USED: {how}. Likeliest reason: {reasons[0]}"


def _reasons(photos: Photographs, findings: Sequence[Finding], trust: Trust | None, residual: float) -> Iterator[str]:
    """Yield what may be wrong, the likeliest first."""
    yield from (finding.text for finding in findings if finding.level == "warning")
    if len(photos) < FEWEST_IMAGES:
        yield f"{len(photos)} photographs are few; take 20 or more, with the lamp all around"
    if photos.mask_origin == "automatic" and photos.mask.all():
        yield "the whole frame is taken for the object; draw a mask.png"
    if trust is not None and trust.doubt:
        yield trust.doubt
    if residual > _MISFIT:
        yield "the model does not describe the object's reflectance, or the light that bounces between its parts"
