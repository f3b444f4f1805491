"""The data term and its gradient in one pass over pixels and images, compiled by numba.

Tests compare it with `image_model.measure_differences`, whose reflectance is that of `reflectance`.
"""

import os
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from sdps.refinement.image_model import (
    DATA_FLOOR,
    ROBUST,
    SHADE_FLOOR,
    SHADOW_EXCESS,
    SHADOW_WEIGHT,
    Model,
)  # fmt: skip
from sdps.refinement.reflectance import LEAST_COSINE, LOBES, SHAPES
from sdps.refinement.sites import Sites

# Waiting threads must sleep: if they spin, two of them take up to thirty times as long next to busy processes.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

BLOCKS = 64
"""Parts of the pixels. Sums are taken part by part, so results do not depend on the number of threads."""
_FLOOR, _ROBUST, _SHADE = np.float32(DATA_FLOOR), np.float32(ROBUST), np.float32(SHADE_FLOOR)
_EXCESS, _WEIGHT = np.float32(SHADOW_EXCESS), np.float32(SHADOW_WEIGHT)
_LEAST = np.float32(LEAST_COSINE)
_NEAREST, _BEHIND = np.float32(1e-4), np.float32(-0.98)  # |off|^2 and l.v are held above these
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


def _read_bits(context: Any, value: Any) -> Any:
    """Read the bits of an int32 as a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), generate


_bits: Any = intrinsic(_read_bits)


@numba.njit(inline="always", fastmath=True)
def _exp(x: Any) -> Any:
    """Return e^x for x <= 40 to 1e-6 of it, in operations that run on several values at once; `math.exp` does not."""
    y = min(max(x, np.float32(-80.0)), np.float32(40.0)) * np.float32(1.44269504)
    whole = np.int32(np.int32(y - np.float32(64.5)) + np.int32(64))  # rounds to the nearest, since y <= 64
    part = (y - np.float32(whole)) * np.float32(0.69314718)
    series = np.float32(1.0 / 720.0) * part + np.float32(1.0 / 120.0)
    series = series * part + np.float32(1.0 / 24.0)
    series = series * part + np.float32(1.0 / 6.0)
    series = series * part + np.float32(0.5)
    series = (series * part + _ONE) * part + _ONE
    return series * _bits((whole + np.int32(127)) << np.int32(23))


@numba.njit(inline="always", fastmath=True)
def _angles(cosine: Any, view: Any, across: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return x, y, n.l held above the least, what o is divided by, and o; of n.l, n.v and l.v."""
    light = max(cosine, _LEAST)
    gap = across - light * view
    below = max(light, view) if gap > _ZERO else _ONE
    return _ONE - light, _ONE - view, light, below, gap / below


@numba.njit(fastmath=True, error_model="numpy")
def _highlights(
    n: Any, lights: np.ndarray, half: np.ndarray, amplitudes: np.ndarray, sharpness: np.ndarray, lag: np.ndarray,
    lobes: np.ndarray, bright: np.ndarray, slope: np.ndarray,
) -> None:  # fmt: skip
    """Write n.h - 1, the lobes over (l.h)^2, their sum and its derivative by n.h."""
    for i in range(len(lag)):
        lag[i] = min(n[0] * half[0, i] + n[1] * half[1, i] + n[2] * half[2, i] - _ONE, _ZERO)
        bright[i] = _ZERO
        slope[i] = _ZERO
    for k in range(LOBES):
        height, sharp = amplitudes[k], sharpness[k]
        for i in range(len(lag)):
            value = _exp(sharp * lag[i]) * (_TWO / (_ONE + lights[2, i]))
            lobes[k, i] = value
            bright[i] += height * value
            slope[i] += height * sharp * value


@numba.njit(fastmath=True, error_model="numpy")
def _matte(n: Any, body: np.ndarray, lights: np.ndarray, matte: np.ndarray) -> None:
    """Write D."""
    first, second, third, last = body[0], body[1], body[2], body[3]
    view = max(n[2], _LEAST)
    for i in range(len(matte)):
        cosine = n[0] * lights[0, i] + n[1] * lights[1, i] + n[2] * lights[2, i]
        x, y, _, _, o = _angles(cosine, view, lights[2, i])
        matte[i] = _exp(first * (x + y) + second * x * y + third * (x * x + y * y) + last * o)


@numba.njit(fastmath=True, error_model="numpy")
def _matte_gradient(
    n: Any, body: np.ndarray, lights: np.ndarray, change: np.ndarray, own: np.ndarray, shape: np.ndarray
) -> tuple[Any, Any, Any]:
    """Add the share of D in the gradients of lights and body, given relative changes of D (L,); return the normal's."""
    first, second, third, last = body[0], body[1], body[2], body[3]
    view, steep = max(n[2], _LEAST), _ONE if n[2] > _LEAST else _ZERO
    gx = gy = gz = b0 = b1 = b2 = b3 = _ZERO
    for i in range(len(change)):
        cosine = n[0] * lights[0, i] + n[1] * lights[1, i] + n[2] * lights[2, i]
        x, y, facing, below, o = _angles(cosine, view, lights[2, i])
        worth = change[i]
        b0 += worth * (x + y)
        b1 += worth * x * y
        b2 += worth * (x * x + y * y)
        b3 += worth * o
        turned = last / below
        bend = turned * max(o, _ZERO)
        nearer = _ONE if facing > view else _ZERO
        by_light = first + second * y + _TWO * third * x + turned * view + bend * nearer
        by_light = -worth * by_light if cosine > _LEAST else _ZERO
        by_view = first + second * x + _TWO * third * y + turned * facing + bend * (_ONE - nearer)
        gx += by_light * lights[0, i]
        gy += by_light * lights[1, i]
        gz += by_light * lights[2, i] - worth * by_view * steep
        own[0, i] += by_light * n[0]
        own[1, i] += by_light * n[1]
        own[2, i] += by_light * n[2] + worth * turned
    shape[0] += b0
    shape[1] += b1
    shape[2] += b2
    shape[3] += b3
    return gx, gy, gz


class _Scratch(NamedTuple):
    """Room for what is worked out of one pixel; (L,) unless said otherwise."""

    lag: np.ndarray  # n.h - 1
    bright: np.ndarray  # the lobes over (l.h)^2, added up
    slope: np.ndarray  # its derivative by n.h
    pull: np.ndarray
    matte: np.ndarray  # D
    change: np.ndarray
    lobes: np.ndarray  # (K, L)


@numba.njit(fastmath=True, error_model="numpy")
def _make_scratch(lamps: int) -> _Scratch:
    return _Scratch(
        np.empty(lamps, np.float32), np.empty(lamps, np.float32), np.empty(lamps, np.float32),
        np.empty(lamps, np.float32), np.empty(lamps, np.float32), np.empty(lamps, np.float32),
        np.empty((LOBES, lamps), np.float32),
    )  # fmt: skip


@numba.njit(fastmath=True, error_model="numpy")
def _one_pixel(
    n: Any, r: Any, scale: Any, body: np.ndarray, amplitudes: np.ndarray, sharpness: np.ndarray, lights: np.ndarray,
    half: np.ndarray, shares: np.ndarray, image: np.ndarray, usable: np.ndarray, scratch: _Scratch, own: np.ndarray,
    lobe: np.ndarray, shape: np.ndarray,
) -> Any:  # fmt: skip
    """Return the term of a pixel and its gradient by normal, albedo and strength; add up the others.

    Args: n and r three numbers each, scale the strength, lights (3, L) and half (3, L) as the pixel sees them, shares
    (3, L), image (3, L), usable (L,). Added to: own (9, L) for directions, half vectors and log intensities, lobe
    (2, K), shape (4,).
    """
    lag, bright, slope, pull, matte, change, lobes = scratch
    (nx, ny, nz), (r0, r1, r2) = n, r
    _highlights(n, lights, half, amplitudes, sharpness, lag, lobes, bright, slope)
    _matte(n, body, lights, matte)
    term = gx = gy = gz = g0 = g1 = g2 = gs = _ZERO
    for i in range(len(lag)):
        cosine = nx * lights[0, i] + ny * lights[1, i] + nz * lights[2, i]
        lit = _ONE if cosine > _ZERO else _ZERO
        shade, floor = max(cosine, _ZERO), max(cosine, _SHADE)
        gloss = scale * bright[i]
        # One channel at a time, written out: a loop of three is not merged with the loop over images.
        y0 = image[0, i] * shares[0, i]
        y1 = image[1, i] * shares[1, i]
        y2 = image[2, i] * shares[2, i]
        value = matte[i]
        o0, o1, o2 = r0 * value, r1 * value, r2 * value
        f0, f1, f2 = o0 + gloss, o1 + gloss, o2 + gloss
        s0, s1, s2 = f0 * floor, f1 * floor, f2 * floor
        d0, d1, d2 = f0 * shade - y0, f1 * shade - y1, f2 * shade - y2
        a0, a1, a2 = _ONE / (s0 * s0 + _FLOOR), _ONE / (s1 * s1 + _FLOOR), _ONE / (s2 * s2 + _FLOOR)
        e0, e1, e2 = (np.sqrt(d0 * d0 * a0 + _ROBUST), np.sqrt(d1 * d1 * a1 + _ROBUST),
                      np.sqrt(d2 * d2 * a2 + _ROBUST))  # fmt: skip
        w0 = usable[i] * (_WEIGHT if d0 > _EXCESS * s0 else _ONE)
        w1 = usable[i] * (_WEIGHT if d1 > _EXCESS * s1 else _ONE)
        w2 = usable[i] * (_WEIGHT if d2 > _EXCESS * s2 else _ONE)
        term += w0 * e0 + w1 * e1 + w2 * e2
        q0, q1, q2 = w0 * d0 * a0 / e0, w1 * d1 * a1 / e1, w2 * d2 * a2 / e2
        g0 += q0 * shade * value
        g1 += q1 * shade * value
        g2 += q2 * shade * value
        change[i] = (q0 * o0 + q1 * o1 + q2 * o2) * shade
        glossy = (q0 + q1 + q2) * shade
        gs += glossy * bright[i]
        pull[i] = glossy * scale
        by_cosine = lit * (q0 * f0 + q1 * f1 + q2 * f2)
        by_lag = pull[i] * slope[i]
        gx += by_cosine * lights[0, i] + by_lag * half[0, i]
        gy += by_cosine * lights[1, i] + by_lag * half[1, i]
        gz += by_cosine * lights[2, i] + by_lag * half[2, i]
        own[0, i] += by_cosine * nx
        own[1, i] += by_cosine * ny
        own[2, i] += by_cosine * nz - pull[i] * bright[i] / (_ONE + lights[2, i])
        own[3, i] += by_lag * nx
        own[4, i] += by_lag * ny
        own[5, i] += by_lag * nz
        own[6, i] += q0 * y0
        own[7, i] += q1 * y1
        own[8, i] += q2 * y2
    mx, my, mz = _matte_gradient(n, body, lights, change, own, shape)
    for k in range(LOBES):
        by_height = by_sharp = _ZERO
        for i in range(len(lag)):
            by_height += pull[i] * lobes[k, i]
            by_sharp += pull[i] * lobes[k, i] * lag[i]
        lobe[0, k] += by_height
        lobe[1, k] += by_sharp * amplitudes[k]
    return term, gx + mx, gy + my, gz + mz, g0, g1, g2, gs


@numba.njit(parallel=True, fastmath=True, cache=True, error_model="numpy")
def _pass(
    normals: np.ndarray, albedo: np.ndarray, strength: np.ndarray, body: np.ndarray, amplitudes: np.ndarray,
    sharpness: np.ndarray, lights: np.ndarray, half: np.ndarray, shares: np.ndarray, images: np.ndarray,
    usable: np.ndarray, total: np.ndarray, pixel: np.ndarray, light: np.ndarray, lobe: np.ndarray, shape: np.ndarray,
) -> None:  # fmt: skip
    """Add up the term and its gradients.

    Args: normals (P, 3), albedo (P, 3), strength (P,), body (4,), amplitudes (K,), sharpness (K,), lights (3, L),
    half (3, L), shares (3, L) reciprocal intensities, images (P, 3, L), usable (P, L) 0 or 1. Written: total (B,),
    pixel (P, 7) for normals, albedo and strength, light (B, 9, L) for directions, half vectors and log intensities,
    lobe (B, 2, K), shape (B, 4).
    """
    count, lamps = images.shape[0], images.shape[2]
    for block in numba.prange(BLOCKS):
        scratch, summed = _make_scratch(lamps), 0.0
        for p in range(block * count // BLOCKS, (block + 1) * count // BLOCKS):
            found = _one_pixel(
                (normals[p, 0], normals[p, 1], normals[p, 2]), (albedo[p, 0], albedo[p, 1], albedo[p, 2]), strength[p],
                body, amplitudes, sharpness, lights, half, shares, images[p], usable[p], scratch, light[block],
                lobe[block], shape[block],
            )  # fmt: skip
            summed += float(found[0])
            for k in range(7):
                pixel[p, k] = found[k + 1]
        total[block] = summed


@numba.njit(fastmath=True, error_model="numpy")
def _see_lamps(
    x: Any, turn: np.ndarray, directions: np.ndarray, nearness: np.ndarray, shares: np.ndarray, lights: np.ndarray,
    half: np.ndarray, stretched: np.ndarray, length: np.ndarray,
) -> None:  # fmt: skip
    """Write lamps as a pixel at x sees them: l and h (3, L), shares over falloff (3, L), 1 / |off| and 1 / |l + v|."""
    for i in range(length.shape[1]):
        rho = nearness[i]
        ox, oy, oz = directions[0, i] - rho * x[0], directions[1, i] - rho * x[1], directions[2, i] - rho * x[2]
        squared = max(ox * ox + oy * oy + oz * oz, _NEAREST)
        inverse = _ONE / np.sqrt(squared)
        ux, uy, uz = ox * inverse, oy * inverse, oz * inverse
        lx = turn[0, 0] * ux + turn[0, 1] * uy + turn[0, 2] * uz
        ly = turn[1, 0] * ux + turn[1, 1] * uy + turn[1, 2] * uz
        lz = max(turn[2, 0] * ux + turn[2, 1] * uy + turn[2, 2] * uz, _BEHIND)
        to_half = _ONE / np.sqrt(lx * lx + ly * ly + (lz + _ONE) * (lz + _ONE))
        lights[0, i], lights[1, i], lights[2, i] = lx, ly, lz
        half[0, i], half[1, i], half[2, i] = lx * to_half, ly * to_half, (lz + _ONE) * to_half
        stretched[0, i], stretched[1, i] = shares[0, i] * squared, shares[1, i] * squared
        stretched[2, i], length[0, i], length[1, i] = shares[2, i] * squared, inverse, to_half


@numba.njit(fastmath=True, error_model="numpy")
def _give_back(
    x: Any, turn: np.ndarray, lights: np.ndarray, half: np.ndarray, length: np.ndarray,
    own: np.ndarray, light: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradient of a pixel's lamps, own (9, L), to that of all: light (7, L), directions, log e, nearness."""
    for i in range(length.shape[1]):
        hx, hy, hz, lx, ly, lz = half[0, i], half[1, i], half[2, i], lights[0, i], lights[1, i], lights[2, i]
        along = own[3, i] * hx + own[4, i] * hy + own[5, i] * hz
        inverse, to_half = length[0, i], length[1, i]
        ax = own[0, i] + (own[3, i] - along * hx) * to_half
        ay = own[1, i] + (own[4, i] - along * hy) * to_half
        az = own[2, i] + (own[5, i] - along * hz) * to_half
        # Observations grow with |off|^2, as if intensities fell.
        stronger = _TWO * (own[6, i] + own[7, i] + own[8, i]) * inverse
        along = ax * lx + ay * ly + az * lz
        tx = (ax - along * lx) * inverse - stronger * lx
        ty = (ay - along * ly) * inverse - stronger * ly
        tz = (az - along * lz) * inverse - stronger * lz
        bx = turn[0, 0] * tx + turn[1, 0] * ty + turn[2, 0] * tz
        by = turn[0, 1] * tx + turn[1, 1] * ty + turn[2, 1] * tz
        bz = turn[0, 2] * tx + turn[1, 2] * ty + turn[2, 2] * tz
        light[0, i] += bx
        light[1, i] += by
        light[2, i] += bz
        light[3, i] += own[6, i]
        light[4, i] += own[7, i]
        light[5, i] += own[8, i]
        light[6, i] -= bx * x[0] + by * x[1] + bz * x[2]


@numba.njit(parallel=True, fastmath=True, cache=True, error_model="numpy")
def _near_pass(
    normals: np.ndarray, albedo: np.ndarray, strength: np.ndarray, body: np.ndarray, amplitudes: np.ndarray,
    sharpness: np.ndarray, directions: np.ndarray, nearness: np.ndarray, places: np.ndarray, turns: np.ndarray,
    shares: np.ndarray, images: np.ndarray, usable: np.ndarray, total: np.ndarray, pixel: np.ndarray,
    light: np.ndarray, lobe: np.ndarray, shape: np.ndarray,
) -> None:  # fmt: skip
    """Do what `_pass` does where each pixel sees lamps of its own.

    Args: as there, and directions (3, L) and nearness (L,) of the lamps, places (P, 3) and turns (P, 3, 3) of `Sites`.
    Written: as there, but light (B, 7, L) for directions, log intensities and nearness.
    """
    count, lamps = images.shape[0], images.shape[2]
    for block in numba.prange(BLOCKS):
        scratch, summed, own = _make_scratch(lamps), 0.0, np.empty((9, lamps), np.float32)
        lights, half = np.empty((3, lamps), np.float32), np.empty((3, lamps), np.float32)
        stretched, length = np.empty((3, lamps), np.float32), np.empty((2, lamps), np.float32)
        for p in range(block * count // BLOCKS, (block + 1) * count // BLOCKS):
            x, turn = (places[p, 0], places[p, 1], places[p, 2]), turns[p]
            _see_lamps(x, turn, directions, nearness, shares, lights, half, stretched, length)
            n = (
                turn[0, 0] * normals[p, 0] + turn[0, 1] * normals[p, 1] + turn[0, 2] * normals[p, 2],
                turn[1, 0] * normals[p, 0] + turn[1, 1] * normals[p, 1] + turn[1, 2] * normals[p, 2],
                turn[2, 0] * normals[p, 0] + turn[2, 1] * normals[p, 1] + turn[2, 2] * normals[p, 2],
            )  # fmt: skip
            own[:] = _ZERO
            term, gx, gy, gz, g0, g1, g2, gs = _one_pixel(
                n, (albedo[p, 0], albedo[p, 1], albedo[p, 2]), strength[p], body, amplitudes, sharpness, lights, half,
                stretched, images[p], usable[p], scratch, own, lobe[block], shape[block],
            )  # fmt: skip
            _give_back(x, turn, lights, half, length, own, light[block])
            summed += float(term)
            for k in range(3):
                pixel[p, k] = turn[0, k] * gx + turn[1, k] * gy + turn[2, k] * gz
            pixel[p, 3], pixel[p, 4], pixel[p, 5], pixel[p, 6] = g0, g1, g2, gs
        total[block] = summed


class _DataTerm(torch.autograd.Function):
    """The mean of the robust differences, and its gradient found on the way."""

    @staticmethod
    def forward(context: Any, images: Tensor, usable: Tensor, sites: Sites | None, *parts: Tensor) -> Tensor:
        arrays = (part.detach().numpy() for part in parts)
        normals, albedo, strength, body, amplitudes, sharpness, directions, half, logs, nearness = arrays
        count, lamps = images.shape[0], images.shape[2]
        total, pixel = np.zeros(BLOCKS), np.empty((count, 7), np.float32)
        lobe, shape = np.zeros((BLOCKS, 2, LOBES), np.float32), np.zeros((BLOCKS, SHAPES), np.float32)
        surface = normals, albedo, strength, body, amplitudes, sharpness, np.ascontiguousarray(directions.T)
        seen = np.ascontiguousarray(np.exp(-logs.T)), images.numpy(), usable.numpy(), total, pixel
        scale = 1.0 / images.numel()
        if sites is None:
            light = np.zeros((BLOCKS, 9, lamps), np.float32)
            _pass(*surface, np.ascontiguousarray(half.T), *seen, light, lobe, shape)
            lights = light.sum(axis=0, dtype=np.float64) * scale  # (9, L)
            of_lights = [lights[:3].T, lights[3:6].T, lights[6:].T, np.zeros(lamps)]
        else:
            light = np.zeros((BLOCKS, 7, lamps), np.float32)
            _near_pass(*surface, nearness, sites.places.numpy(), sites.turns.numpy(), *seen, light, lobe, shape)
            lights = light.sum(axis=0, dtype=np.float64) * scale  # (7, L)
            of_lights = [lights[:3].T, np.zeros((lamps, 3)), lights[3:6].T, lights[6]]
        heights, sharps = lobe.sum(axis=0, dtype=np.float64) * scale
        pixel *= scale
        of_pixels = pixel[:, :3], pixel[:, 3:6], pixel[:, 6]
        shapes = shape.sum(axis=0, dtype=np.float64) * scale
        found = (*of_pixels, shapes, heights, sharps, *of_lights)
        context.save_for_backward(*(torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in found))
        return torch.tensor(total.sum() * scale)

    @staticmethod
    def backward(context: Any, incoming: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, None, *(part * incoming.float() for part in context.saved_tensors))


def data_term(model: Model, images: Tensor, usable: Tensor, sites: Sites | None = None) -> Tensor:
    """Return the mean of r (`sdps.refinement.image_model`) over pixels, channels and images; differentiable.

    Args:
        model: The model; float32 on the CPU.
        images: (P, 3, L) float32, I / G, contiguous.
        usable: (P, L) float32, 0 where an observation is ignored, else 1.
        sites: Where the pixels lie; None: lamps are distant, the camera is orthographic.
    """
    return _DataTerm.apply(images, usable, sites, *(part.contiguous() for part in model))
