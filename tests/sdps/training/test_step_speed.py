"""The speed of training is timed on the network that will be trained."""

import torch

from pipelines.shared import presets
from sdps.training import step_speed
from sdps.training.step_speed import images_per_second


def test_steps_are_timed_on_the_network_that_will_be_trained(monkeypatch) -> None:
    preset = presets.load("smoke", ["normals.images=2", "lighting.images=2", "lighting.batch_scenes=1"])
    timed = []
    create = step_speed.create_stage

    def record(name, model, config, trained):
        timed.append((name, model, sorted(trained)))
        return create(name, model, config, trained)

    monkeypatch.setattr(step_speed, "create_stage", record)
    for name in ("lcnet", "nenet"):
        assert images_per_second(preset.run(name), torch.device("cpu")) > 0.0
    assert timed == [(name, name, sorted(preset.run(name).requires)) for name in ("lcnet", "nenet")]
