"""The study of refinement under low-order light: its starts and its table."""

import numpy as np
from sdps_scenes import write_data

from lab.studies import low_order_study
from lab.studies.low_order_study import Gain, disturb, summarise
from sdps.core.metrics import angle_degrees


def test_a_start_is_off_by_so_many_degrees_and_has_no_detail():
    y, x = np.mgrid[1:-1:80j, -1:1:80j]
    mask = np.hypot(x, y) < 0.9
    normals = np.dstack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))]) * mask[..., None]
    one, again, other = (disturb(normals, mask, np.random.default_rng(seed)) for seed in (0, 0, 1))
    errors = angle_degrees(one[mask], normals[mask])
    assert 7.0 < np.sqrt((errors**2).mean()) < 10.0
    assert (one == again).all() and not (one == other).all()
    np.testing.assert_allclose(np.linalg.norm(one[mask], axis=1), 1.0, atol=1e-5)
    assert (one[mask][:, 2] > 0).all() and (one[~mask] == 0).all()
    still = disturb(normals, mask, np.random.default_rng(0), 0.0)
    assert angle_degrees(still[mask], normals[mask]).mean() < 3.0


def test_a_run_prints_a_table(tmp_path, capsys):
    write_data(tmp_path / "data", ("train", "val", "val"), lights=60, size=32)
    assert low_order_study.main([str(tmp_path / "data"), "--scenes", "1", "--images", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith(("lamps and room, ", "surroundings, ", "distant lamps, ")) for line in lines) == 3


def test_the_table_counts_what_got_worse():
    gains = [
        Gain("surroundings", 8, 9.0, 8.0, (0.01, 0.005), True, 2.0),
        Gain("surroundings", 8, 7.0, 8.0, (0.01, 0.02), False, 4.0),
    ]
    (line,) = (line for line in summarise(gains, [8, 16]).splitlines() if "surroundings" in line)
    words = line.replace("|", " ").split()
    assert words == ["surroundings", "8", "2", "8.00", "8.00", "1", "1", "3.0"]
