"""Batches of scenes rendered meanwhile: the same at any pace, after a stop, and in several processes."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from sdps_scenes import hemisphere_lights, sphere_normals

from render.records.manifest import SceneSpec, View
from render.records.shards import to_half
from render.shared.errors import InputError
from sdps.data.augment import Augmentation
from sdps.data.dataset import Batch, SampleOptions
from sdps.data.scene_store import StoredScene
from sdps.data.streamed_scenes import StreamedScenes

OPTIONS = SampleOptions(seed=0, images=3, size=16, augmentation=Augmentation())


def planned(count: int = 7, lights: int = 4) -> list[SceneSpec]:
    return [
        SceneSpec(
            id=f"s{number}", seed=number, split="train", shape="sphere", material="lambert", view=View(), size=16,
            spp=1, bounces=0,
            lights=tuple(map(tuple, hemisphere_lights(lights, np.random.default_rng(number)).tolist())),
        )
        for number in range(count)
    ]  # fmt: skip


PLAN = planned()


class Rendered:
    """A stream of discs, each as bright as its place in the stream tells; it may be slow, fail, or never answer."""

    def __init__(
        self, start: int, pause: float = 0.0, fails_at: int | None = None, hangs_at: int | None = None
    ) -> None:
        self.number, self.pause, self.fails_at, self.hangs_at = start, pause, fails_at, hangs_at
        self.closed = threading.Event()

    def __next__(self) -> tuple[SceneSpec, StoredScene]:
        if self.number == self.hangs_at:
            self.closed.wait()
            raise InputError("closed")
        if self.number == self.fails_at:
            raise InputError(f"scene {self.number} cannot be rendered")
        time.sleep(self.pause)
        scene = PLAN[self.number % len(PLAN)]
        normals, mask = sphere_normals(16)
        images = to_half(np.full((len(scene.lights), 16, 16, 3), self.number / 16, np.float32) * mask[..., None])
        self.number += 1
        return scene, StoredScene(images, normals, mask, normals[..., 2])

    def close(self) -> None:
        self.closed.set()


def source(open_stream: Callable = Rendered, options: SampleOptions = OPTIONS, **changes) -> StreamedScenes:
    return StreamedScenes(PLAN, open_stream, options, **{"batch": 4, "window": 6, "fresh": 0.5} | changes)


@pytest.fixture
def sources() -> Iterator[Callable[..., StreamedScenes]]:
    """Yield `source`, closing what it made."""
    made = []

    def make(*args, **changes) -> StreamedScenes:
        made.append(source(*args, **changes))
        return made[-1]

    yield make
    for each in made:
        each.close()


def same(first: Batch, second: Batch) -> bool:
    return all(torch.equal(*pair) for pair in zip(first, second, strict=True))


def places(batch: Batch) -> list[int]:
    """Return the numbers of a batch's scenes in the stream, exposed as they are."""
    brightest = (batch.images / batch.intensities[..., None, None, None]).amax((1, 2, 3, 4))
    return [round(16 * float(value)) for value in brightest]


def test_batch_depends_on_its_number_alone(sources) -> None:
    whole = list(islice(sources().batches(0), 9))
    slow = list(islice(sources(lambda start: Rendered(start, pause=0.002)).batches(0), 9))
    assert all(same(*pair) for pair in zip(whole, slow, strict=True))
    for number in (1, 4, 7):
        resumed = islice(sources().batches(4 * number), 2)
        assert all(same(*pair) for pair in zip(whole[number:], resumed, strict=False))
    other = next(sources(options=replace(OPTIONS, seed=1)).batches(0))
    assert not same(other, whole[0])


def test_one_source_may_start_again(sources) -> None:
    streams = []

    def open_stream(start: int) -> Rendered:
        streams.append(Rendered(start))
        return streams[-1]

    again = sources(open_stream)
    first = list(islice(again.batches(0), 3))
    assert same(next(again.batches(4)), first[1])
    assert [stream.closed.is_set() for stream in streams] == [True, False]
    again.close()
    assert streams[1].closed.is_set()
    again.close()


@pytest.mark.parametrize(("fresh", "firsts"), [(0.5, [0, 1, 1, 2, 2]), (1, [0, 1, 2, 3, 4]), (2.5, [0, 3, 5, 8, 10])])
def test_window_moves_by_fresh_scenes_per_batch(sources, fresh: float, firsts: list[int]) -> None:
    moving = sources(fresh=fresh, window=4, batch=4)
    assert [moving.first(number) for number in range(5)] == firsts
    assert sources(fresh=0.1).first(30) == 3
    stream = Rendered(0)
    plain = Augmentation(exposure="paper", exposure_range=(1.0, 1.0), noise=0.0, clip=1e6)
    exposed = sources(lambda start: stream, replace(OPTIONS, augmentation=plain), fresh=fresh, window=4)
    for first, batch in zip(firsts, exposed.batches(0), strict=False):
        assert sorted(places(batch)) == [first, first + 1, first + 2, first + 3]
    exposed.close()
    assert stream.number <= firsts[-1] + 4 + np.ceil(fresh)  # at most one batch ahead


def test_scenes_are_drawn_evenly_and_never_twice_in_a_batch(sources) -> None:
    plain = Augmentation(exposure="paper", exposure_range=(1.0, 1.0), noise=0.0, clip=1e6)
    batches = list(islice(sources(options=replace(OPTIONS, augmentation=plain), fresh=1).batches(0), 60))
    drawn = [places(batch) for batch in batches]
    assert all(len(set(row)) == 4 and set(row) <= set(range(k, k + 6)) for k, row in enumerate(drawn))
    times = np.bincount(np.concatenate(drawn))[6:59]
    assert times.mean() == pytest.approx(4, abs=0.2) and times.max() <= 6
    assert len(torch.cat([batch.seed for batch in batches]).unique()) == 240


def test_processes_share_every_batch(sources) -> None:
    whole = islice(sources().batches(8), 3)
    parts = [islice(sources(rank=rank, world=2).batches(8), 3) for rank in range(2)]
    for batch, *shares in zip(whole, *parts, strict=True):
        assert [len(share.images) for share in shares] == [2, 2]
        assert same(batch, Batch(*(torch.cat(tensors) for tensors in zip(*shares, strict=True))))


def test_mistakes_of_the_renderer_are_handed_on_once(sources) -> None:
    given = list(sources(lambda start: Rendered(start, fails_at=8)).batches(0))
    # Batches 0 to 4 need the scenes 0 to 7, batch 5 the ninth.
    assert [isinstance(item, InputError) for item in given] == [False] * 5 + [True]
    assert str(given[-1]) == "scene 8 cannot be rendered"


def test_closing_ends_a_wait_for_the_renderer(sources) -> None:
    stuck = sources(lambda start: Rendered(start, hangs_at=6))
    batches = stuck.batches(0)
    next(batches)  # the thread now waits for the seventh scene
    stuck.close()
    assert next(batches, None) is None


def test_defects_are_not_taken_for_mistakes(sources) -> None:
    class Broken(Rendered):
        def __next__(self):
            raise RuntimeError("defect")

    with pytest.raises(RuntimeError, match="defect"):
        next(sources(Broken).batches(0))


def test_identity_holds_what_decides_the_batches() -> None:
    identity = source().identity()
    assert source().scenes == identity["scenes"] == 7
    json.dumps(identity)
    assert source(batch=2).identity() == identity  # the trainer's configuration has it
    changed = [source(window=8), source(fresh=1), source(options=replace(OPTIONS, seed=1)),
               StreamedScenes(planned(8), Rendered, OPTIONS, batch=4, window=6, fresh=0.5)]  # fmt: skip
    assert all(other.identity() != identity for other in changed)
    assert len({other.identity()["data"] for other in changed}) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": 3}, r"stream\.window 3 must be at least batch_scenes 4"),
        ({"fresh": 0}, r"stream\.fresh must be above 0"),
        ({"fresh": 7}, r"at most stream\.window \(6\), got 7"),
        ({"world": 3}, "cannot be shared by 3 processes"),
    ],
)
def test_bad_settings_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        source(**changes)


def test_unusable_plans_and_places_are_refused() -> None:
    with pytest.raises(InputError, match="no scene to train on"):
        StreamedScenes([], Rendered, OPTIONS, batch=4, window=6, fresh=1)
    with pytest.raises(InputError, match="set images to 2 or less"):
        StreamedScenes([*PLAN, *planned(1, lights=2)], Rendered, OPTIONS, batch=4, window=6, fresh=1)
    with pytest.raises(InputError, match="multiple of batch_scenes"):
        source().batches(5)
