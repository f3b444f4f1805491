"""Tables of other layouts: which line or light a message names, and what editors leave at the beginning of a file."""

from pathlib import Path

import numpy as np
import pytest

from render.planning import light_sets
from render.shared.errors import InputError, list_names
from render.shared.files import parse_json, read_text
from render.shared.tables import (
    check_directions,
    line_of_row,
    number_lines,
    read_light_list,
    read_names,
    read_numbers,
)


def test_lines_are_counted_as_editors_count_them(tmp_path: Path) -> None:
    text = "a\x0cb\u2028c\r\n\r\nd\re\n"
    assert number_lines(text) == [(1, "a\x0cb\u2028c"), (2, ""), (3, "d"), (4, "e"), (5, "")]
    path = tmp_path / "table.txt"
    path.write_bytes(b"0 0 1\r\n\r\n\r\n0 1\x0c 0\r\n0 x 1\r\n")
    assert (line_of_row(path, 1), line_of_row(path, 2)) == (4, 5)
    with pytest.raises(InputError, match=r"line 5: '0 x 1' are not numbers"):
        read_numbers(path, 3)


def test_the_mark_of_windows_editors_is_no_part_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "names.txt"
    path.write_bytes("\ufeffa.png\r\nb.png\r\n".encode())
    assert read_names(path) == ["a.png", "b.png"]
    path.write_bytes("\ufeff[1]".encode())
    assert parse_json(read_text(path)) == [1]


def test_all_lights_that_are_wrong_are_named(tmp_path: Path) -> None:
    lights = np.tile([0.0, 0.0, 1.0], (5, 1))
    lights[[1, 3]] *= -1
    with pytest.raises(InputError, match=r"light 2 is behind the object \(z = -1\); .* \(lights 2, 4\)"):
        check_directions(lights, "l.txt")
    with pytest.raises(InputError, match=r"light 2 has length 3\.0000; .* \(b, d\)"):
        check_directions(lights * -3 + [0, 0, 4] * (lights > 0), "l.txt", list("abcde"))
    path = tmp_path / "list.txt"
    path.write_text("2.png 0 0 1\n10.png 0 0 1\n9.png 0 0 2\n")
    with pytest.raises(InputError, match=r"light 2 has length 2\.0000; .*\(9\.png\)"):
        read_light_list(path)
    path.write_text("a.png\nb.png\na.png\nb.png\nc.png\n")
    with pytest.raises(InputError, match=r"'a.png', 'b.png' are listed twice"):
        read_names(path)


def test_sets_of_lights_name_the_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    path.write_text("# mine\n\n0 0 1  # above\n\n0 1\n")
    with pytest.raises(InputError, match=r"light 2: expected three numbers x y z, got \['0', '1'\] \(line 5\)"):
        light_sets.load(str(path))


def test_many_names_are_cut() -> None:
    assert list_names(["a", "b", "c"], 2) == "a, b, c"  # one more is no longer than "1 more"
    assert list_names([str(number) for number in range(9)], 2) == "0, 1 and 7 more"
