"""`sdps doctor`."""

import re

from pipelines.cli import main
from render.shared.errors import InputError


def test_doctor_reports_variant_and_cores(capsys):
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    for name in ("mitsuba", "variant", "libLLVM", "cores", "free disk"):
        assert re.search(rf"^{name}\s+\S", text, re.MULTILINE)


def test_doctor_passes_on_a_small_disk_and_says_so(capsys, monkeypatch):
    monkeypatch.setattr("pipelines.doctor.free_bytes", lambda folder: 3_200_000_000)
    assert main(["doctor"]) == 0
    assert "3.2 GB; the demo takes about 5.0 GB, choose another --out" in capsys.readouterr().out


def test_doctor_that_cannot_fetch_says_so_and_goes_on(capsys, monkeypatch):
    def fails(*_: object) -> None:
        raise InputError("no network; sudo apt-get install libllvm19")

    monkeypatch.setattr("render.backend.variant.choose", fails)
    monkeypatch.setattr("render.backend.llvm.fetch", fails)
    assert main(["doctor", "--fix"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "not fetched: no network; sudo apt-get install libllvm19"
    assert any(line.startswith("bunny mesh ") for line in said) and said[-1].startswith("missing: Mitsuba variant:")
