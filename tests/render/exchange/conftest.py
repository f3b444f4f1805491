"""A data folder of four scenes, and its tree in every layout; read-only by convention."""

from pathlib import Path

import pytest
from exchange_support import write_folder

from render.exchange.export import ExportOptions, export
from render.exchange.layouts import LAYOUTS
from render.records.manifest import read_manifest


@pytest.fixture(scope="package")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_folder(folder)
    return folder


@pytest.fixture(scope="package")
def trees(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("trees")
    for layout in LAYOUTS:
        export(data, root / layout, ExportOptions(layout=layout), read_manifest(data))
    return {layout: root / layout for layout in LAYOUTS}
