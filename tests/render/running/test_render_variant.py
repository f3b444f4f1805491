"""Which variant and libLLVM are chosen, and what is said when there is none."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from render.backend import llvm, variant
from render.shared.errors import InputError


@pytest.fixture
def clean(monkeypatch):
    """Forget the environment's choice, and see neither GPU nor libLLVM until a test says so."""
    monkeypatch.delenv("SDPS_VARIANT", raising=False)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(variant, "has_cuda_driver", lambda: False)
    monkeypatch.setattr(variant, "find_llvm", lambda: [])
    monkeypatch.setattr(variant, "works", lambda *_: True)
    return monkeypatch


def choose() -> variant.Choice:
    return variant.choose.__wrapped__()


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.19.1", 19), ("libLLVM-17.so.1", 17), ("libLLVM-14.so", 14), ("libLLVM.20.dylib", 20),
        ("libLLVM.so", None), ("libLTO.so.19", None),
    ],
)  # fmt: skip
def test_version_is_read_from_the_file_name(name, version):
    assert variant.llvm_version(Path("/nowhere") / name) == version


def test_version_is_read_through_a_link(tmp_path):
    (tmp_path / "libLLVM.so.18.1").touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.18.1")
    assert variant.llvm_version(tmp_path / "libLLVM.so") == 18


def test_this_machine_has_a_usable_variant():
    mi = variant.load()
    assert mi.variant() == variant.choose().variant and variant.load() is mi


def test_known_good_library_is_taken_untried(clean):
    clean.setattr(variant, "find_llvm", lambda: [(19, Path("/x/libLLVM.so.19.1")), (20, Path("/x/libLLVM.so.20"))])
    clean.setattr(variant, "works", lambda *_: pytest.fail("tried"))
    assert choose().llvm == Path("/x/libLLVM.so.19.1")


def test_other_versions_are_tried_and_aborting_ones_are_not(clean):
    tried = []

    def works(_name: str, path: Path) -> bool:
        tried.append(path.name)
        return "17" in path.name

    clean.setattr(variant, "works", works)
    clean.setattr(variant, "find_llvm", lambda: [(n, Path(f"/x/libLLVM.so.{n}")) for n in (20, 17, 16, 15, 14)])
    assert choose().llvm == Path("/x/libLLVM.so.17")
    assert tried == ["libLLVM.so.20", "libLLVM.so.17"]


@pytest.mark.parametrize("versions", [(), (16,), (14, 15)])
def test_without_a_usable_library_the_remedy_is_told(clean, versions):
    clean.setattr(variant, "find_llvm", lambda: [(n, Path(f"/x/libLLVM.so.{n}")) for n in versions])
    with pytest.raises(InputError, match=r"no working libLLVM.*apt-get install libllvm19") as caught:
        choose()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [14, 15, 16])
def test_a_given_library_that_aborts_is_refused(clean, tmp_path, version):
    path = tmp_path / f"libLLVM-{version}.so.1"
    path.touch()
    clean.setenv("DRJIT_LIBLLVM_PATH", str(path))
    with pytest.raises(InputError, match=f"libLLVM {version} aborts"):
        choose()


def test_a_library_that_drjit_cannot_load_is_reported(tmp_path):
    """In a process of its own, as Dr.Jit loads its library once. The message also shows that loading was waited for."""
    path = tmp_path / "libLLVM.so.18.1"
    path.touch()
    code = (
        "from render.shared.errors import InputError\n"
        "try:\n    import render.backend.jit\n"
        "except InputError as error:\n    print(error)"
    )
    environment = {**os.environ, "SDPS_VARIANT": "llvm_ad_rgb", "DRJIT_LIBLLVM_PATH": str(path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{path}: Dr.Jit could not load this libLLVM; install libLLVM 19"), done.stderr


def test_a_given_library_is_used_or_reported_missing(clean, tmp_path):
    path = tmp_path / "libLLVM.so.18.1"
    clean.setenv("DRJIT_LIBLLVM_PATH", str(path))
    with pytest.raises(InputError, match="no such file"):
        choose()
    path.touch()
    assert choose().llvm == path


def test_forced_variants(clean):
    clean.setenv("SDPS_VARIANT", "scalar_rgb")
    with pytest.raises(InputError, match="use cuda_ad_rgb or llvm_ad_rgb"):
        choose()
    clean.setenv("SDPS_VARIANT", "cuda_ad_rgb")
    with pytest.raises(InputError, match="no CUDA device"):
        choose()
    clean.setattr(variant, "has_cuda_driver", lambda: True)
    assert choose().variant == "cuda_ad_rgb"
    clean.setattr(variant, "works", lambda *_: False)
    with pytest.raises(InputError, match="OptiX failed"):
        choose()
    clean.setenv("SDPS_VARIANT", "llvm_ad_rgb")
    clean.setattr(variant, "find_llvm", lambda: [(19, Path("/x/libLLVM.so.19.1"))])
    assert choose().variant == "llvm_ad_rgb"


def test_a_gpu_without_optix_falls_back_to_the_cpu(clean):
    clean.setattr(variant, "has_cuda_driver", lambda: True)
    clean.setattr(variant, "works", lambda name, *_: name == "llvm_ad_rgb")
    clean.setattr(variant, "find_llvm", lambda: [(19, Path("/x/libLLVM.so.19.1"))])
    choice = choose()
    assert choice.variant == "llvm_ad_rgb" and "no GPU with a working OptiX" in choice.reason


# --- fetching a libLLVM ---


def test_fetch_without_apt_says_what_to_install(monkeypatch):
    monkeypatch.setattr(llvm.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="install libLLVM 19"):
        llvm.fetch()


def test_fetch_reports_the_failing_command_in_one_line(monkeypatch):
    failed = subprocess.CompletedProcess([], 100, stdout="", stderr="reading lists\nE: no such package\n")
    monkeypatch.setattr(llvm.shutil, "which", lambda name: "/usr/bin/apt-get")
    monkeypatch.setattr(llvm.subprocess, "run", lambda *args, **options: failed)
    with pytest.raises(InputError, match="no such package") as caught:
        llvm.fetch()
    assert "\n" not in str(caught.value)


def test_fetch_unpacks_into_the_cache_without_root(monkeypatch, tmp_path):
    def run(command, **options):
        if command[0] == "apt-get":
            (Path(options["cwd"]) / "libllvm19.deb").write_text("")
        else:
            library = Path(command[-1]) / "usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"
            library.parent.mkdir(parents=True)
            library.write_text("")
        return subprocess.CompletedProcess(command, 0, stdout="", stderr="")

    monkeypatch.setenv("SDPS_CACHE", str(tmp_path))
    monkeypatch.setattr(llvm.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(llvm.shutil, "which", lambda name: "/usr/bin/apt-get")
    monkeypatch.setattr(llvm.subprocess, "run", run)
    tried = []
    monkeypatch.setattr(llvm, "works", lambda name, path: tried.append(path) or True)
    assert "unpacked" in llvm.fetch()
    assert tried == [tmp_path / "llvm/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"]
