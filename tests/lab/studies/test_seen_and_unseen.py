"""The study of scenes that were learned from and others: its table."""

from sdps_scenes import write_data

from lab.studies import seen_and_unseen


def test_both_splits_are_measured_in_mixed_light_and_under_single_lamps(tmp_path, capsys):
    write_data(tmp_path, ("train", "train", "val"), lights=60, size=32)
    assert seen_and_unseen.main([str(tmp_path), "--scenes", "1"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(("train", "val"))]
    assert [row[:3] for row in rows] == [
        [split, light, "1"] for split in ("train", "val") for light in ("all", "single")
    ]
    assert all(0.0 < float(row[3]) < 90.0 for row in rows)
