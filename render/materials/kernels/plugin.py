"""What the project's Mitsuba BSDF plugins have in common: Mitsuba's interface over packed families.

A packed family holds materials of one kind in Dr.Jit arrays (see `render.materials.kernels.packed`); a plugin is a
weighted sum of some of its materials.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

from render.backend.jit import dr, mi


@cache
def register(name: str, kind: type) -> None:
    """Register the BSDF plugin `kind` under a name, once."""
    mi.register_bsdf(name, kind)


class FamilyBSDF(mi.BSDF):
    """One-sided BSDF sum_k w_k(x) f_k of materials of packed families; by default the first material of the first.

    Args:
        props: Properties of the plugin.
        families: Packed families; their arrays are exposed to `mi.traverse`, numbered where there are several.
    """

    def __init__(self, props: "mi.Properties", families: Sequence[Any]) -> None:
        mi.BSDF.__init__(self, props)
        self.families = tuple(families)
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def parts(self, si: "mi.SurfaceInteraction3f") -> list[tuple]:
        """Return (family, UInt32 index, weight) of each material at N points; the weights sum to 1."""
        return [(self.families[0], mi.UInt32(0), mi.Float(1))]

    def seen(self, si: "mi.SurfaceInteraction3f") -> tuple[list[tuple], "mi.Frame3f | None"]:
        """Return `parts`, and the frame that a relief turns the shading frame into, in its coordinates, or None."""
        return self.parts(si), None

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple:
        """Choose a material by its weight, then a direction from its lobes; the weight is f cos / pdf of the sum."""
        active &= mi.Frame3f.cos_theta(si.wi) > 0
        parts, frame = self.seen(si)
        wi = _turned(frame, si.wi)
        wo, reached = mi.Vector3f(0, 0, 1), mi.Float(0)
        for family, index, weight in parts:
            mine = (sample1 >= reached) & (weight > 0)
            rest = dr.clip((sample1 - reached) / dr.maximum(weight, 1e-9), 0, 1)
            wo = dr.select(mine, family.sample_lobe(index, wi, rest, sample2, active & mine), wo)
            reached += weight
        wo = wo if frame is None else frame.to_world(wo)
        value, density = _eval(parts, frame, si, wo, active), _pdf(parts, frame, si, wo, active)
        valid = active & (density > 0)
        sample = dr.zeros(mi.BSDFSample3f, dr.width(density))
        sample.wo = wo
        sample.pdf = dr.select(valid, density, 0)
        sample.eta = 1.0
        sample.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        sample.sampled_component = mi.UInt32(0)
        return sample, dr.select(valid, value / density, 0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return f cos(theta_o)."""
        return _eval(*self.seen(si), si, wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of `sample` per solid angle."""
        return _pdf(*self.seen(si), si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple:
        """Return both `eval` and `pdf`."""
        parts, frame = self.seen(si)
        return _eval(parts, frame, si, wo, active), _pdf(parts, frame, si, wo, active)

    def traverse(self, callback: Any) -> None:
        """Expose the families' arrays."""
        for number, family in enumerate(self.families):
            prefix = f"family{number}_" if len(self.families) > 1 else ""
            for name, value in vars(family).items():
                if isinstance(value, mi.Float):
                    callback.put(prefix + name, value, mi.ParamFlags.NonDifferentiable)


def _turned(frame: Any, direction: Any) -> Any:
    return direction if frame is None else frame.to_local(direction)


def _eval(parts: list[tuple], frame: Any, si: Any, wo: Any, active: Any) -> "mi.Color3f":
    total = mi.Color3f(0)
    for family, index, weight in parts:
        total += weight * family.eval(index, _turned(frame, si.wi), _turned(frame, wo), active & _above(frame, si, wo))
    return total


def _pdf(parts: list[tuple], frame: Any, si: Any, wo: Any, active: Any) -> "mi.Float":
    total = mi.Float(0)
    for family, index, weight in parts:
        total += weight * family.pdf(index, _turned(frame, si.wi), _turned(frame, wo), active & _above(frame, si, wo))
    return total


def _above(frame: Any, si: Any, wo: Any) -> Any:
    """Where there is a relief, both directions must be above the surface that carries it too."""
    return mi.Bool(True) if frame is None else (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
