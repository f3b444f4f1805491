"""Samples made on a device, beside those that loader processes make: the same physics, other random numbers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sdps_samples import options, rng
from sdps_scenes import write_data

from render.records.manifest import SceneSpec, View
from render.records.view_geometry import incident, points
from render.shared.errors import InputError
from render.shared.imaging.mixing import LightMix
from render.shared.imaging.sensor import SensorModel
from sdps.core.geometry import reach
from sdps.data.augment import Augmentation, exposure_scale
from sdps.data.dataset import Batch, SampleKey, SampleOptions, SceneDataset, collate
from sdps.data.resident.device_samples import Held, crop_corners, exposure_scales, make_batch, prepare, require_possible
from sdps.data.scene_store import StoredScene

STEADY = Augmentation(mean_jitter=(1.0, 1.0), intensity_range=(1.0, 1.0), noise=0.0, clip=1e3, mean_level=0.3)
DEVICE = torch.device("cpu")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> SceneDataset:
    path = tmp_path_factory.mktemp("data")
    write_data(path, ("train",) * 6, lights=12, size=32)
    return SceneDataset(path, "train", options(images=12), cache=False)


def hold(dataset: SceneDataset, size: int = 32) -> Held:
    held = Held(len(dataset), 12, size, DEVICE)
    for scene in dataset.scenes:
        held.add(prepare(scene, dataset.store.load(scene), size))
    return held


def batch(dataset: SceneDataset, seed: int = 0, size: int = 32, **changes: object) -> Batch:
    made = options(**{"images": 12, "size": size, "augmentation": STEADY, **changes})
    return make_batch(hold(dataset, size), np.arange(len(dataset)), made, rng(seed))


def test_images_normals_and_lights_turn_together(dataset: SceneDataset) -> None:
    made = batch(dataset, augmentation=replace(STEADY, symmetries=True))
    assert len({tuple(row) for row in made.directions[:, 0].tolist()}) == 6
    shading = torch.einsum("bchw,bqc->bqhw", made.normals, made.directions).clamp(min=0.0) * made.mask
    ratio = made.images / shading[:, :, None].clamp(min=1e-6)
    for scene in range(6):
        lit = (shading[scene] > 0.2)[:, None].expand(-1, 3, -1, -1)
        colours = (ratio[scene] * lit).sum(dim=(0, 2, 3)) / lit.sum(dim=(0, 2, 3))  # albedo times exposure
        found = (ratio[scene] / colours[:, None, None])[lit]
        assert (found - 1.0).abs().max() < 5e-3  # images are kept in 16 bits


def test_near_lamps_light_pixels_from_where_they_lie() -> None:
    lights = ((0.3, 0.2, 0.9327), (-0.5, 0.1, 0.8602), (0.0, 0.6, 0.8))
    scene = SceneSpec(id="near", seed=0, split="train", shape="sphere", material="lambertian:1", view=View(),
                      lights=lights, size=16,
                      spp=1, bounces=0, light_distances=(2.5, 3.0, 4.0))  # fmt: skip
    mask = np.ones((16, 16), bool)
    depth = rng().uniform(-0.3, 0.3, (16, 16)).astype(np.float32)
    normals = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), (16, 16, 3))
    where = points(depth.astype(np.float64)).reshape(-1, 3)
    directions, irradiance = incident(where, scene.light_directions(), scene.light_positions(), np.zeros(3))
    images = np.repeat((irradiance * directions[..., 2]).reshape(3, 16, 16, 1), 3, axis=-1)
    held = Held(1, 3, 16, DEVICE)
    held.add(prepare(scene, StoredScene(images.astype(np.float16), normals, mask, depth), 16))
    made = make_batch(held, np.zeros(1, int), options(images=3, size=16, augmentation=replace(STEADY, symmetries=True)),
                      rng(3))  # fmt: skip
    places = made.places[0].flatten(1).T
    towards, falloff = reach(places, made.directions[0], made.nearness[0])
    ours = (towards[..., 2] * falloff).T.reshape(3, 16, 16)
    ratio = made.images[0, :, 0] / ours
    torch.testing.assert_close(ratio / ratio.mean(), torch.ones_like(ratio), atol=2e-3, rtol=0)


def statistics(made: Batch) -> list[float]:
    inside = made.mask[:, None]
    count = inside.sum() * made.images.shape[1] * 3
    mean = (made.images * inside).sum() / count
    dark = (made.images * (1.0 - inside)).abs().mean()
    spread = ((made.images - mean).square() * inside).sum() / count
    clipped = (made.images >= 0.999).float().mean()
    lights = made.intensities.mean(), made.directions[..., 2].mean()
    return [float(each) for each in (mean, spread, clipped, dark, *lights)]


@pytest.mark.parametrize("sensor", [None, SensorModel()], ids=["plain", "cameras"])
def test_samples_are_those_of_loader_processes_on_average(dataset: SceneDataset, sensor: SensorModel | None) -> None:
    how = Augmentation(symmetries=True, biased=0.3, frontal=0.2, noise=0.0 if sensor else 0.05, sensor=sensor)
    wanted: SampleOptions = options(images=5, augmentation=how)
    loaded = SceneDataset(dataset.store.folder, "train", wanted, cache=False)
    slow = [statistics(collate([loaded.sample(SampleKey(k, 0, 6 * turn + k)) for k in range(6)])) for turn in range(40)]
    held = hold(dataset)
    fast = [statistics(make_batch(held, np.arange(6), wanted, rng(turn))) for turn in range(40)]
    difference = np.mean(slow, axis=0) - np.mean(fast, axis=0)
    error = np.sqrt((np.var(slow, axis=0) + np.var(fast, axis=0)) / 40)
    assert (np.abs(difference) < 4.0 * error + 1e-6).all(), (difference, error)


def test_other_sizes_are_resized_once(dataset: SceneDataset) -> None:
    made = batch(dataset, size=16)
    assert made.images.shape == (6, 12, 3, 16, 16)
    torch.testing.assert_close(made.normals.norm(dim=1), made.mask[:, 0])


def test_the_number_of_images_may_vary(dataset: SceneDataset) -> None:
    counts = {batch(dataset, seed, images=7, fewest=3).images.shape[1] for seed in range(30)}
    assert counts == {3, 4, 5, 6, 7}


def test_exposure_is_that_of_the_loader() -> None:
    images = torch.from_numpy(rng().exponential(1.0, (4, 3, 3, 8, 8)).astype(np.float32))
    images[1] *= 100.0
    images[3] = 0.0
    mask = torch.from_numpy((rng().random((4, 1, 8, 8)) > 0.4).astype(np.float32))
    found = exposure_scales(images, mask, 0.3, 1.0).flatten()
    for scene in range(4):
        values = images[scene].permute(0, 2, 3, 1)[:, mask[scene, 0] > 0].numpy()
        assert float(found[scene]) == pytest.approx(float(exposure_scale(values, 0.3, 1.0)), rel=1e-5)


def test_crops_lie_on_the_object() -> None:
    mask = torch.zeros(3, 1, 32, 32)
    mask[0, 0, 2:6, 20:30] = 1.0  # small: the best of what was tried
    mask[1, 0, 10:30, 4:28] = 1.0  # the last has no object
    corners = crop_corners(mask, 12, 0.3, torch.Generator().manual_seed(0))
    assert (corners >= 0).all() and (corners <= 20).all()
    for scene, least in ((0, 0.05), (1, 0.3)):
        row, column = corners[scene].tolist()
        assert mask[scene, 0, row : row + 12, column : column + 12].mean() >= least


def test_what_loaders_alone_make_is_refused() -> None:
    for changes in ({"rescale": True}, {"augmentation": Augmentation(exposure="paper")},
                    {"augmentation": Augmentation(mixed=LightMix())}):  # fmt: skip
        with pytest.raises(InputError, match="set resident to false"):
            require_possible(options(**changes))
