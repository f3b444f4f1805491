"""Widen lightset to lightset-second: further channels with zero weights."""
import sys
import torch
from sdps.models import registry
from sdps.models.checkpoint import TrainedModel, load_weights, save_weights

first = load_weights("assets/weights/lightset.safetensors")
second = registry.create("lightset-second", **first.options)
state, old = second.state_dict(), first.network.state_dict()
for name, value in state.items():
    if name not in old:
        print("new", name, tuple(value.shape)); continue
    if value.shape == old[name].shape:
        state[name] = old[name]; continue
    print("wider", name, tuple(value.shape), tuple(old[name].shape))
    value = torch.zeros_like(value)
    if "shared" in name:  # means, then maxima, of the channels
        n, m = old[name].shape[1] // 2, value.shape[1] // 2
        value[:, :n] = old[name][:, :n]; value[:, m:m + n] = old[name][:, n:]
    else:
        value[:, :old[name].shape[1]] = old[name]
    state[name] = value
second.load_state_dict(state)
print(sum(p.numel() for p in second.parameters()))
save_weights(sys.argv[1], TrainedModel("lightset-second", second, first.options, dict(first.metadata)))
