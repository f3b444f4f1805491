"""MERL tables: the format to the byte, the meaning of an entry, interpolation, and the errors a user can meet."""

import numpy as np
import pytest
from merl_support import glossy, hemisphere, values

from lab.studies.fit_library import half_difference
from render.materials import library, merl
from render.shared.errors import InputError

ENTRIES = 90 * 90 * 180


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("merl") / "glossy.binary"
    merl.write(file, values("glossy"))
    return file


@pytest.fixture
def blank():
    """A table of zeros to write into."""
    return np.zeros((3, *merl.SHAPE), np.float32)


def angles(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return theta_h, theta_d, phi_d by turning the vectors, as the reader of the database does."""
    half, difference = half_difference(wi, wo)
    return (
        np.arctan2(half[:, 0], half[:, 2]),
        np.arccos(np.clip(difference[:, 2], -1, 1)),
        np.arctan2(difference[:, 1], difference[:, 0]) % np.pi,
    )


def pairs(count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Return directions above the horizon, a third of them within a few degrees of mirror reflection."""
    wi, wo = hemisphere(count, 1), hemisphere(count, 2)
    near = wi[::3] * [-1, -1, 1] + np.random.default_rng(3).normal(scale=0.03, size=wi[::3].shape)
    wo[::3] = near / np.linalg.norm(near, axis=1, keepdims=True)
    keep = wo[:, 2] > 0.02
    return wi[keep], wo[keep]


def test_the_file_is_laid_out_as_the_database_has_it(path):
    raw = path.read_bytes()
    assert len(raw) == 12 + 3 * ENTRIES * 8
    assert np.frombuffer(raw, "<i4", 3).tolist() == [90, 90, 180]
    planes = np.frombuffer(raw, "<f8", offset=12).reshape(3, ENTRIES)
    row, column, cell = 20, 33, 141
    entry = cell + 180 * (column + 90 * row)
    wi, wo = merl.centres(row)
    expected = glossy(wi, wo)[column * 180 + cell]
    scaled = planes[:, entry] * np.array([1 / 1500, 1.15 / 1500, 1.66 / 1500])
    np.testing.assert_allclose(scaled, expected, rtol=1e-6)


def test_a_written_table_is_read_back_to_the_bit(path):
    table = library.load(path)
    assert (table.name, table.category, table.path) == ("glossy", "measured", str(path))
    assert table.values.dtype == np.float32 and not table.values.flags.writeable
    np.testing.assert_array_equal(np.where(table.valid, table.values, -1), values("glossy"))
    assert library.load(str(path)) is table  # read once


def test_a_rewritten_file_is_read_again(tmp_path, blank):
    file = tmp_path / "changing.binary"
    merl.write(file, blank + 1)
    assert library.load(file).values[0, 0, 0, 0] == 1
    merl.write(file, blank + 2)
    assert library.load(file).values[0, 0, 0, 0] == 2


def test_centres_are_what_truncation_looks_up():
    """The reader of the database truncates; the centres must fall in their own cells, in the middle of each."""
    for row in (0, 1, 40, 89):
        wi, wo = merl.centres(row)
        theta_h, theta_d, phi_d = angles(wi, wo)
        np.testing.assert_allclose(np.sqrt(theta_h * 2 / np.pi) * 90, row + 0.5, atol=1e-6)
        column, cell = np.divmod(np.arange(len(wi)), 180)
        np.testing.assert_allclose(theta_d * 180 / np.pi, column + 0.5, atol=1e-5)
        np.testing.assert_allclose(phi_d * 180 / np.pi, cell + 0.5, atol=1e-5)


@pytest.mark.parametrize("entry", [(0, 0, 0), (5, 40, 179), (31, 12, 90)])
def test_one_entry_is_seen_at_its_centre_alone(blank, entry):
    row, column, cell = entry
    blank[:, row, column, cell] = 1, 2, 3
    table = merl.build(blank, "spike")
    value = merl.evaluate(table, *merl.centres(row)).reshape(90, 180, 3)
    np.testing.assert_allclose(value[column, cell], [1, 2, 3], rtol=1e-6)
    value[column, cell] = 0
    assert np.abs(value).max() < 1e-6
    assert np.abs(merl.evaluate(table, *merl.centres(row + 1))).max() < 1e-6


@pytest.mark.parametrize("axis", [0, 1])
def test_interpolation_is_linear_in_the_coordinates_of_the_table(blank, axis):
    number = (np.arange(90) + 0.5).reshape((90, 1, 1) if axis == 0 else (1, 90, 1))
    wi, wo = pairs()
    theta_h, theta_d, _ = angles(wi, wo)
    coordinate = 90 * (np.sqrt(theta_h * 2 / np.pi) if axis == 0 else theta_d * 2 / np.pi)
    inside = (coordinate > 0.5) & (coordinate < 89.5)
    value = merl.evaluate(merl.build(blank + number, "ramp"), wi, wo)
    np.testing.assert_allclose(value[inside, 1], coordinate[inside], rtol=1e-5)


def test_azimuth_is_periodic(blank):
    table = merl.build(blank + 1 + np.cos(2 * np.pi * (np.arange(180) + 0.5) / 180), "wave")
    wi, wo = pairs()
    theta_h, theta_d, phi_d = angles(wi, wo)
    inside = (theta_h > 0.01) & (theta_d > 0.02)
    value = merl.evaluate(table, wi, wo)[inside, 0]
    np.testing.assert_allclose(value, 1 + np.cos(2 * phi_d[inside]), atol=1e-3)


def test_azimuth_does_not_matter_where_it_is_undefined(blank):
    table = merl.build(blank + np.random.default_rng(4).random(merl.SHAPE), "noise")
    turn = np.linspace(0, 2 * np.pi, 50)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(50)], 1)
    wi = np.tile([0.6, 0.0, 0.8], (50, 1))
    for wo in (wi, wi * [-1, -1, 1]):  # theta_d = 0, theta_h = 0
        moved = wo + 1e-10 * around
        value = merl.evaluate(table, wi, moved / np.linalg.norm(moved, axis=1, keepdims=True))
        assert np.isfinite(value).all() and np.ptp(value, axis=0).max() < 2e-3


def test_reciprocity_is_exact_and_the_table_isotropic(blank):
    table = merl.build(blank + np.random.default_rng(5).random((3, *merl.SHAPE)), "noise")
    wi, wo = pairs()
    value = merl.evaluate(table, wi, wo)
    np.testing.assert_array_equal(value, merl.evaluate(table, wo, wi))
    turn = np.array([[np.cos(1.0), -np.sin(1.0), 0], [np.sin(1.0), np.cos(1.0), 0], [0, 0, 1]])
    np.testing.assert_allclose(value, merl.evaluate(table, wi @ turn.T, wo @ turn.T), atol=1e-5)
    down = np.array([[0.6, 0, -0.8]])
    assert not merl.evaluate(table, down, wi[:1]).any() and not merl.evaluate(table, wi[:1], down).any()


def test_a_table_reproduces_the_brdf_it_was_made_of(path):
    wi, wo = pairs()
    value, expected = merl.evaluate(library.load(path), wi, wo), glossy(wi, wo)
    error = np.abs(value - expected) / expected
    # Close to the horizon the lobe bends within a cell; only there is the table, not its reading, at fault.
    assert np.median(error) < 1e-3 and np.percentile(error, 99) < 0.02


def test_white_stays_white_up_to_the_horizon():
    table = merl.build(values("lambertian:1"), "white")
    assert 0.7 < table.valid.mean() < 0.8  # the others lie below the horizon
    wi, wo = hemisphere(5000, 6), hemisphere(5000, 7)
    wo[0] = np.array([1, 0, 1e-6]) / np.hypot(1, 1e-6)
    np.testing.assert_allclose(merl.evaluate(table, wi, wo), 1 / np.pi, rtol=1e-6)


def test_what_was_not_measured_takes_its_neighbours_colour_and_is_marked(blank):
    blank[:] = np.arange(90).reshape(90, 1, 1) + 1
    blank[1, 60:] = -0.5  # one bad channel spoils the entry
    blank[:, :, 50] = -1
    table = merl.build(blank, "holes")
    assert table.values.min() >= 0 and not table.valid[:, 50].any() and not table.valid[60:].any()
    assert (table.values[:, 60:] == 60).all()
    np.testing.assert_array_equal(table.values[:, :, 50], table.values[:, :, 49])
    wi, wo = pairs()
    theta_h, theta_d, _ = angles(wi, wo)
    row, column = np.sqrt(theta_h * 2 / np.pi) * 90, np.degrees(theta_d)
    known = merl.is_measured(table, wi, wo)
    assert known[(row < 59) & (column < 49)].all()
    assert not known[row > 60.5].any() and not known[np.abs(column - 50.5) < 0.9].any()
    np.testing.assert_array_equal(np.isnan(merl.as_brdf(table)(wi, wo)).any(1), ~known)


def test_bivariate_is_the_mean_over_the_azimuth():
    table = merl.build(values("glossy"), "glossy")
    theta_h, theta_d = np.array([0.02, 0.1, 0.5]), np.array([0.2, 0.6])
    phi_d = (np.arange(180) + 0.5) * np.pi / 180
    wi, wo = merl.directions(theta_h[:, None, None], theta_d[:, None], phi_d)
    mean = merl.evaluate(table, wi.reshape(-1, 3), wo.reshape(-1, 3)).reshape(3, 2, 180, 3).mean(2)
    np.testing.assert_allclose(merl.bivariate(table, theta_h, theta_d).transpose(1, 2, 0), mean, rtol=1e-5)


# ---- Errors ----------------------------------------------------------------------------------------


def damaged(path, name: str, change) -> str:  # change: function of the file's bytes
    """Write a changed copy, expect one line naming the file, and return it."""
    copy = path.with_name(f"{name}.binary")
    copy.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError) as caught:
        library.load(copy)
    message = str(caught.value)
    assert str(copy) in message and "\n" not in message
    return message


def test_bad_files_are_explained(path):
    assert "header" in damaged(path, "empty", lambda raw: b"")
    assert "found 90, 90, 360" in damaged(path, "anisotropic", lambda raw: raw[:8] + b"\x68\x01\0\0" + raw[12:])
    assert "size: expected 34,992,012 bytes, found 34,991,912" in damaged(path, "cut", lambda raw: raw[:-100])
    assert "found 34,992,013" in damaged(path, "longer", lambda raw: raw + b"\0")
    nan, inf = np.array([np.nan]).tobytes(), np.array([np.inf]).tobytes()
    at = 12 + 8 * (ENTRIES + 7 + 180 * (3 + 90 * 2))
    message = damaged(path, "nan", lambda raw: raw[:at] + nan + raw[at + 8 :])
    assert "green plane" in message and "(2, 3, 7)" in message and "nan" in message
    assert "inf" in damaged(path, "inf", lambda raw: raw[:at] + inf + raw[at + 8 :])
    assert "every entry is negative" in damaged(path, "none", lambda raw: raw[:12] + (-np.ones(3 * ENTRIES)).tobytes())
    with pytest.raises(InputError, match="no such file"):
        library.load(path.with_name("absent.binary"))
    path.with_name("folder.binary").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        library.load(path.with_name("folder.binary"))


def test_arrays_of_another_form_are_refused(tmp_path, blank):
    with pytest.raises(InputError, match="shape"):
        merl.write(tmp_path / "x.binary", blank[:, :, :, :90])
    with pytest.raises(InputError, match="not a finite number"):
        merl.write(tmp_path / "x.binary", blank + np.nan)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"merl\.build"):
        merl.MerlTable(name="x", values=blank - 1, valid=np.ones(merl.SHAPE, bool))
    with pytest.raises(InputError, match="valid"):
        merl.MerlTable(name="x", values=blank, valid=np.ones(3, bool))


def test_files_of_another_kind_say_which_there_are(tmp_path):
    (tmp_path / "wood.txt").write_text("")
    for name in (tmp_path / "wood.txt", tmp_path / "missing"):
        with pytest.raises(InputError, match=r"\.yaml \(fitted\), \.binary \(MERL\) or \.bsdf \(RGL\)"):
            library.load(name)
    (tmp_path / "broken.bsdf").write_bytes(b"no tensors")
    with pytest.raises(InputError, match=r"broken\.bsdf"):
        library.load(tmp_path / "broken.bsdf")
    with pytest.raises(InputError, match=r"did you mean 'chrome'.*\.binary"):
        library.load("crome")
