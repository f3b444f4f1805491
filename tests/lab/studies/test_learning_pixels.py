"""The study of how many pixels layers before the fusion learn from."""

from sdps_scenes import write_data

from lab.studies import learning_pixels


def test_all_pixels_teach_what_they_teach_and_some_nearly_that(tmp_path, capsys):
    write_data(tmp_path, ("train",) * 12, lights=60, size=32)
    assert learning_pixels.main([str(tmp_path), "--rounds", "1"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(("1 of", "another"))]
    cosines = [float(row[-1]) for row in rows]
    assert cosines[0] == 1.0 and 0.5 < cosines[1] < 1.0 and abs(cosines[-1]) < cosines[1]
