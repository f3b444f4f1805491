"""The image-formation model: an object's reflectance (`reflectance`), lamps far or near, robust differences.

Pixel p, image i, channel c; f without G is rho D + S of `reflectance`:

    q_pic = (rho_pc D_pi + S_pi) max(n_p . l_i, 0)                                      predicted radiance
    y_pic = I_pic / (e_ic G_pi falloff_pi)                                              radiance under equal lights
    r_pic = w_pic sqrt((q_pic - y_pic)^2 / (sigma_pic^2 + 0.05) + 1e-4)                 robust difference
    sigma_pic = (rho_pc D_pi + S_pi) max(n_p . l_i, 0.05)                               constant in the gradient

with n and l turned until the line of sight is z, and l and falloff those of each pixel where lamps are near (`sites`).
I is divided by its mean over the object, after light that bounced off other parts of it is subtracted, and e by its own
mean. G is constant in the gradient; functions here take I / G. w is 0 where a pixel is black although it is lit
elsewhere (`find_shadows`) or a cast shadow was traced (`transport`), 0.15 where it is darker than the model explains
by half of sigma (perhaps another shadow), else 1.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, softplus

from sdps.refinement.reflectance import half_vectors, measure_angles, reflect
from sdps.refinement.sites import Seen, Sites, see

DATA_FLOOR = 0.05
"""Added to the squared scale of a difference, so that dark pixels do not outweigh bright ones."""
ROBUST = 1e-4
SHADE_FLOOR = 0.05
SHADOW_EXCESS, SHADOW_WEIGHT = 0.5, 0.15
_BLACK, _DARKER_SHARE = 0.1, 0.9


class State(NamedTuple):
    """What is refined; tensors float32, lengths and signs in the project's frame.

    Attributes:
        normals: (P, 3) towards unit length.
        log_albedo: (P, 3) logarithm of rho.
        log_strength: (P,) logarithm of s.
        body: (4,) b.
        lobes: (K,) a before softplus.
        log_sharpness: (K,) logarithm of kappa.
        directions: (L, 3) from the surface to the light, towards unit length.
        log_intensities: (L, 3).
        whiteness: () albedo of the brightest parts, which decides how much light bounces.
        modes: (M,) m of `sdps.refinement.reflectance`.
        log_nearness: () logarithm of rho (`sdps.core.geometry`), which all lamps share; -inf: distant.
        uneven: (L,) what is added to it for each lamp.
    """

    normals: Tensor
    log_albedo: Tensor
    log_strength: Tensor
    body: Tensor
    lobes: Tensor
    log_sharpness: Tensor
    directions: Tensor
    log_intensities: Tensor
    whiteness: Tensor
    modes: Tensor
    log_nearness: Tensor
    uneven: Tensor


class Model(NamedTuple):
    """The state as the equations use it.

    Attributes:
        normals: (P, 3) unit.
        albedo: (P, 3).
        strength: (P,).
        body: (4,).
        amplitudes: (K,).
        sharpness: (K,).
        directions: (L, 3) unit.
        half: (L, 3) unit half vectors.
        log_intensities: (L, 3), the mean of their exponentials 1.
        nearness: (L,) rho.
    """

    normals: Tensor
    albedo: Tensor
    strength: Tensor
    body: Tensor
    amplitudes: Tensor
    sharpness: Tensor
    directions: Tensor
    half: Tensor
    log_intensities: Tensor
    nearness: Tensor

    def see(self, sites: Sites | None, part: slice = slice(None)) -> Seen:
        """Return the normals and lamps of some pixels as they see them; `sites` are those of all."""
        own = None if sites is None else sites.select(part)
        return see(self.normals[part], self.directions, self.nearness, own)

    def select(self, part: slice) -> "Model":
        """Return the model of some pixels."""
        return self._replace(normals=self.normals[part], albedo=self.albedo[part], strength=self.strength[part])


def build_model(state: State) -> Model:
    """Return the state as the equations use it; differentiable."""
    normals, directions = normalize(state.normals, dim=-1), normalize(state.directions, dim=-1)
    logs = state.log_intensities
    return Model(
        normals=normals,
        albedo=state.log_albedo.exp(),
        strength=state.log_strength.exp(),
        body=state.body,
        amplitudes=softplus(state.lobes),
        sharpness=state.log_sharpness.exp(),
        directions=directions,
        half=half_vectors(directions),
        log_intensities=logs - logs.logsumexp((0, 1)) + np.log(logs.numel()),
        nearness=(state.log_nearness + state.uneven).exp(),
    )


def find_shadows(radiance: Tensor) -> Tensor:  # (P, L) bool
    """Return where a pixel is black: below a tenth of the mean of its darkest 90 % of images.

    Args:
        radiance: (P, 3, L), y with the first intensities.
    """
    grey = radiance.mean(dim=1)  # (P, L)
    count = max(1, round(_DARKER_SHARE * grey.shape[1]))
    darker = grey.sort(dim=1).values[:, :count].mean(dim=1, keepdim=True)
    return grey < _BLACK * darker


def measure_differences(model: Model, images: Tensor, dark: Tensor, sites: Sites | None = None) -> Tensor:  # (P, 3, L)
    """Return r of the module's text, whose mean is `fused.data_term`; differentiable.

    Args:
        model: The model.
        images: (P, 3, L), I / G.
        dark: (P, L) bool, observations that are ignored.
        sites: Where the pixels lie; None: lamps are distant, the camera is orthographic.
    """
    seen = model.see(sites)
    cosine = seen.cosines  # (P, L)
    reflected = reflect(measure_angles(seen.normals, seen.directions), model)
    observed = seen.even_out(images / model.log_intensities.exp().T)  # (P, 3, L)
    sigma = (reflected * cosine.clamp_min(SHADE_FLOOR)[:, None]).detach()
    gap = reflected * cosine.clamp_min(0.0)[:, None] - observed
    weight = torch.where(gap > SHADOW_EXCESS * sigma, SHADOW_WEIGHT, 1.0) * ~dark[:, None]
    return weight * (gap**2 / (sigma**2 + DATA_FLOOR) + ROBUST).sqrt()


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What refinement found; frame: x right, y up, z to the camera.

    Attributes:
        normals: (H, W, 3) float32 unit, zero outside the mask.
        light_directions: (L, 3) float32 unit, from the surface to the light.
        intensities: (L, 3) float32, mean 1.
        albedo: (H, W, 3) float32, zero outside the mask, up to a common factor.
        strength: (H, W) float32, of the highlights, zero outside the mask.
        body: (4,) numbers b of the body (`sdps.refinement.reflectance`); 0 is Lambertian.
        amplitudes: (K,) of the lobes.
        sharpness: (K,) of the lobes.
        modes: (M,) numbers m of the modes; 0 adds nothing.
        nearness: (L,) float32, rho of the lamps (`sdps.core.geometry`); 0 where they are taken for distant.
        pixel_residual: (H, W) float32, mean robust difference, zero outside the mask.
        image_residual: (L,) float32, the same of each image.
        used: (H, W) float32, share of the images that are not in shadow or clipped there.
    """

    normals: np.ndarray
    light_directions: np.ndarray
    intensities: np.ndarray
    albedo: np.ndarray
    strength: np.ndarray
    body: np.ndarray
    amplitudes: np.ndarray
    sharpness: np.ndarray
    modes: np.ndarray
    nearness: np.ndarray
    pixel_residual: np.ndarray
    image_residual: np.ndarray
    used: np.ndarray

    @property
    def grey_intensities(self) -> np.ndarray:
        """Intensities (L,): channels weighted by how much of them the object reflects, since dark ones tell little."""
        weights = self.albedo.reshape(-1, 3).sum(axis=0, dtype=np.float64)
        return (self.intensities @ (weights / weights.sum())).astype(np.float32)
