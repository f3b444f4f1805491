"""Which variant and libLLVM are chosen, and what is said when there is none."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from render.backend import llvm, variant
from render.shared.errors import InputError

ROOT = Path(__file__).resolve().parents[3]


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
def test_without_a_usable_library_the_remedy_is_named(clean, versions):
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


class Distribution:
    """Pretends to be apt-get, apt-cache and dpkg-deb; `knows`: packages it lists, `broken`: it cannot send."""

    def __init__(self, monkeypatch, cache, knows, broken=()):
        self.knows, self.broken, self.commands, self.tried = knows, broken, [], []
        monkeypatch.setenv("SDPS_CACHE", str(cache))
        monkeypatch.setattr(llvm.shutil, "which", lambda name: f"/usr/bin/{name}")
        monkeypatch.setattr(llvm.subprocess, "run", self.run)

    def run(self, command, **options):
        self.commands.append(command)
        said, code = "", 0
        if "pkgnames" in command:
            said = "\n".join(self.knows)
        elif "install" in command and command[-1] in self.broken:
            said, code = "reading lists\nE: Failed to fetch it\n", 100
        elif "install" in command:
            (cache,) = (word.partition("=")[2] for word in command if word.startswith("Dir::Cache="))
            for name in (command[-1], "libc6"):
                (Path(cache) / "archives" / f"{name}_1.deb").write_text("")
        elif command[0] == "dpkg-deb":
            name = Path(command[2]).name.partition("_")[0]
            library = Path(command[-1]) / f"usr/lib/x86_64-linux-gnu/libLLVM.so.{name[7:9]}.1"
            library.parent.mkdir(parents=True, exist_ok=True)
            library.write_text("")
        return subprocess.CompletedProcess(command, code, stdout="" if code else said, stderr=said if code else "")


def test_fetch_without_apt_says_what_to_install(monkeypatch):
    monkeypatch.setattr(llvm.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match=r"sudo apt-get install libllvm19; Fedora: sudo dnf .*brew install"):
        llvm.fetch()


def test_fetch_reports_the_failing_command_in_one_line(monkeypatch, tmp_path):
    Distribution(monkeypatch, tmp_path, ["libllvm19"], broken=["libllvm19"])
    with pytest.raises(InputError, match=r"apt-get install: E: Failed to fetch it") as caught:
        llvm.fetch()
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
    Distribution(monkeypatch, tmp_path, ["libllvm14", "libllvm-19-ocaml-dev"])
    with pytest.raises(InputError, match=r"apt lists none from 17 on"):
        llvm.fetch()


@pytest.mark.parametrize("user", [0, 1000])
@pytest.mark.parametrize("folder", ["cache", "cache [1]"])
def test_fetch_unpacks_into_the_cache_and_installs_nothing_even_as_root(user, folder, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "geteuid", lambda: user)
    apt = Distribution(monkeypatch, tmp_path / folder, ["libllvm16", "libllvm22", "libllvm17t64", "libllvm19"])
    monkeypatch.setattr(llvm, "works", lambda name, path: apt.tried.append(path) or True)
    assert "nothing was installed" in llvm.fetch()
    assert apt.tried == [tmp_path / folder / "llvm/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"]
    assert [path.name for path in (tmp_path / folder).iterdir()] == ["llvm"]
    for command in apt.commands:
        if command[0] == "apt-get":
            own = {word.partition("=")[0] for word in command if word.startswith("Dir::")}
            assert own == {"Dir::State", "Dir::State::status", "Dir::Cache"}
            assert "update" in command or "--download-only" in command
        assert command[0] in ("apt-get", "apt-cache", "dpkg-deb") and "libc6_1.deb" not in command[2]


def test_fetch_goes_on_to_the_next_version_and_leaves_none_that_does_not_work(monkeypatch, tmp_path):
    apt = Distribution(monkeypatch, tmp_path, ["libllvm17t64", "libllvm18", "libllvm20"])
    monkeypatch.setattr(llvm, "works", lambda name, path: apt.tried.append(path.name) or "18" in path.name)
    assert "libllvm18" in llvm.fetch() and apt.tried == ["libLLVM.so.20.1", "libLLVM.so.18.1"]
    monkeypatch.setattr(llvm, "works", lambda name, path: False)
    with pytest.raises(InputError, match="fetched libllvm20, libllvm18, libllvm17t64, but no test render passed"):
        llvm.fetch()
    assert not list(tmp_path.iterdir())


def test_a_cache_of_ones_own_does_without_a_library_of_its_own(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "users [1]"))
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path / "own"))
    library = tmp_path / "users [1]/sdps/llvm/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"
    library.parent.mkdir(parents=True)
    library.write_text("")
    assert variant.find_llvm()[0] == (19, library)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_what_an_unpacked_library_needs_is_loaded_from_its_folder(monkeypatch, tmp_path):
    """In a process of its own: of three libraries each needs the next, and the system knows none."""
    place = tmp_path / "llvm/usr/lib/x86_64-linux-gnu"
    place.mkdir(parents=True)
    before = []
    for name in ("libsdpsthird.so.1", "libsdpssecond.so.1", "libLLVM.so.19.1"):
        words = ["cc", "-shared", "-fPIC", "-x", "c", "/dev/null", "-o", str(place / name), f"-Wl,-soname,{name}"]
        subprocess.run([*words, "-x", "none", "-Wl,--no-as-needed", *before], check=True)
        before = [str(place / name)]
    code = (
        "import ctypes, sys, pathlib\nfrom render.backend import variant\npath = pathlib.Path(sys.argv[1])\n"
        "print(*(found.name for found in variant.load_companions(path)))\nctypes.CDLL(str(path))\n"
    )
    monkeypatch.setenv("SDPS_CACHE", str(tmp_path))
    done = subprocess.run([sys.executable, "-c", code, before[0]], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["libsdpsthird.so.1", "libsdpssecond.so.1"]
    assert variant.load_companions(tmp_path / "libLLVM.so.19.1") == []
