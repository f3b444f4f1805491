"""The study of what wrong lights cost: what the network is told, and the table."""

import torch
from sdps_scenes import write_data
from torch.nn import functional

from lab.studies import told_lights
from sdps.data.dataset import Batch
from sdps.models.base import Lights


def test_the_best_linear_map_undoes_one_that_all_directions_were_moved_by():
    true = functional.normalize(torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    bent = functional.normalize(true @ torch.tensor([[1.0, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 1.2]]), dim=-1)
    batch = Batch(**{name: torch.zeros(1, 9) for name in Batch._fields})._replace(directions=true)
    told = told_lights.tell(Lights(bent, torch.ones(1, 9)), batch)
    moved = told["found, moved by the best linear map"].directions
    off = [float((each - true).norm(dim=-1).mean()) for each in (bent, moved)]
    assert off[1] < 0.3 * off[0]
    assert told["and that they are exact"].expected_error is None


def test_normals_are_measured_by_what_is_told_of_their_lights(tmp_path, capsys):
    write_data(tmp_path, ("train", "train", "val"), lights=60, size=32)
    assert told_lights.main([str(tmp_path), "--scenes", "1"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(("found", "true", "and"))]
    assert len(rows) == 6 and all(0.0 < float(value) < 90.0 for row in rows for value in row[-2:])
