"""The study of what tells lamps from rooms: its table."""

import pytest
from any_light_weights import write_weights
from sdps_scenes import write_data

from lab.studies import lamps_or_room


@pytest.mark.parametrize(("spread", "seen"), [(0.1, 0), (0.3, 2)])
def test_scenes_are_counted_that_are_lit_from_many_sides(tmp_path, capsys, spread, seen):
    write_data(tmp_path / "data", ("val", "val"), lights=60, size=32)
    models = str(write_weights(tmp_path / "out", spread))
    assert lamps_or_room.main([str(tmp_path / "data"), "--models", models, "--scenes", "2"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines()[1:] if " of " in line]
    assert len(rows) == 5 * len(lamps_or_room.COUNTS)
    for row in rows:  # no scene has near lamps
        if row.startswith("flat discs"):
            assert ("15 of 15" if seen else "0 of 15") in row
        else:
            assert ("0 of 0" if row.startswith("near") else f"{seen} of 2") in row
